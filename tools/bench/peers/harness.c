// SPDX-License-Identifier: Apache-2.0
// A peer on a simulated AVR: takes rows of PEER_CHANNELS features from GPIOR2 (a count in two bytes first),
// asks the peer between two marks in GPIOR0 (1 begins, 2 ends), writes what it answered, two floats, to
// GPIOR1 and stops in its sleep.
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>

#include "peer.h"

static uint16_t take(void)
{
    const uint8_t low = GPIOR2;
    return (uint16_t)(low | GPIOR2 << 8);
}

int main(void)
{
    for (uint16_t rows = take(); rows != 0; rows--) {
        uint16_t feature[PEER_CHANNELS];
        float gaze_deg[2];
        for (uint8_t j = 0; j < PEER_CHANNELS; j++)
            feature[j] = take();
        GPIOR0 = 1;
        peer_predict(feature, gaze_deg);
        GPIOR0 = 2;
        for (uint8_t i = 0; i < sizeof gaze_deg; i++)
            GPIOR1 = ((const uint8_t *)gaze_deg)[i];
    }
    cli();
    sleep_enable();
    sleep_cpu();
    for (;;)
        ;
}
