// SPDX-License-Identifier: Apache-2.0
// A network on an ATmega328P, without a port: marks what it does in GPIOR0 (2k+1 begin, 2k+2 end of section
// k), writes every result to GPIOR1 byte by byte and stops.
//
// case_data.h is made by tests/unit/mlp_avr_harness.py: image and inputs.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>

#include "case_data.h"
#include "sg_mlp.h"

enum { FLASH, MEMORY, OPEN, EMPTY };

#define BEGIN(k) (GPIOR0 = 2 * (k) + 1)
#define END(k) (GPIOR0 = 2 * (k) + 2)
#define STACK_FILL 0xA5

extern uint8_t _end, __stack;

static void put(const void *data, uint8_t n)
{
    const uint8_t *byte = data;
    while (n--)
        GPIOR1 = *byte++;
}

// From the end of the variables up to here: painted, and counted afterwards.
static void __attribute__((noinline)) paint(void)
{
    for (uint8_t *at = &_end; at < (uint8_t *)SP - 8; at++)
        *at = STACK_FILL;
}

static uint16_t __attribute__((noinline)) deepest(uint16_t from)
{
    const uint8_t *at = &_end;
    while (*at == STACK_FILL)
        at++;
    return from - (uint16_t)(uintptr_t)at;
}

static uint16_t scratch[SG_MLP_SCRATCH_MAX];

static void __attribute__((noinline)) evaluate(const struct sg_mlp_view *view, uint8_t section)
{
    for (uint16_t i = 0; i < CASE_POINTS; i++) {
        uint16_t input[SG_MLP_INPUTS_MAX];
        int16_t output[SG_MLP_OUTPUTS_MAX];
        uint8_t flags;
        memcpy_P(input, case_input[i], sizeof input);
        int verdict;
        if (section == FLASH) {
            BEGIN(FLASH);
            verdict = sg_mlp_predict(view, input, scratch, output, &flags);
            END(FLASH);
        } else {
            BEGIN(MEMORY);
            verdict = sg_mlp_predict(view, input, scratch, output, &flags);
            END(MEMORY);
        }
        put(output, (uint8_t)(2 * view->outputs));
        put(&flags, 1);
        put(&verdict, 1);
    }
}

#if CASE_IN_MEMORY
static uint8_t copy[sizeof case_image];
#endif

int main(void)
{
    struct sg_mlp_view view;
    BEGIN(EMPTY);
    END(EMPTY);
    BEGIN(OPEN);
    int8_t verdict = (int8_t)sg_mlp_open(&view, case_image, sizeof case_image, 1);
    END(OPEN);
    put(&verdict, 1);
    if (verdict == 0) {
        paint();
        const uint16_t here = SP;
        evaluate(&view, FLASH);
        const uint16_t stack = deepest(here);
        put(&stack, 2);
#if CASE_IN_MEMORY
        memcpy_P(copy, case_image, sizeof copy);
        verdict = (int8_t)sg_mlp_open(&view, copy, sizeof copy, 0);
        put(&verdict, 1);
        evaluate(&view, MEMORY);
#endif
    }
    cli();
    sleep_enable();
    sleep_cpu();
    for (;;)
        ;
}
