// SPDX-License-Identifier: Apache-2.0
// Networks under hostile bytes: every byte of images of every shape is changed, the CRC repaired, and what
// sg_mlp_open still accepts is evaluated, in blocks of exactly the stated sizes. Exit 1 with a sentence on a
// broken invariant; the sanitizers see to reads and writes out of bounds.
//
//   mlp_fuzz SEED ROUNDS
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sg_err.h"
#include "sg_mlp.h"
#include "sg_model.h"

#define HOLDS(condition, what)                                                                              \
    do {                                                                                                    \
        if (!(condition)) {                                                                                 \
            fprintf(stderr, "broken invariant: %s (line %d)\n", what, __LINE__);                            \
            exit(1);                                                                                        \
        }                                                                                                   \
    } while (0)

static unsigned long long state;
static unsigned long opened, refused[16];

// Below n; 0 for n = 0.
static uint32_t draw(uint32_t n)
{
    state = state * 6364136223846793005ULL + 1442695040888963407ULL;
    return n == 0 ? 0 : (uint32_t)(state >> 33) % n;
}

static void *block(size_t n)
{
    void *made = malloc(n == 0 ? 1 : n);
    if (made == NULL)
        exit(2);
    return made;
}

static void put32(uint8_t *at, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        at[i] = (uint8_t)(value >> (8 * i));
}

static void seal(uint8_t *image, size_t n)
{
    put32(image + offsetof(struct sg_mlp_head, crc), sg_model_crc32(0, image + 8, n - 8));
}

static unsigned even(unsigned n)
{
    return (n + 1) & ~1u;
}

// An image that is right: wild weights, small enough for the bound, wild biases and scales. Counts, up to
// `ends` inputs and outputs and `widest` units, may be more than the format allows, its only fault then.
static size_t make_image(uint8_t **out, unsigned widest, unsigned ends)
{
    struct sg_mlp_head head;
    memset(&head, 0, sizeof head);
    head.magic = SG_MLP_MAGIC;
    head.version = SG_MLP_VERSION;
    head.inputs = (uint8_t)(1 + draw(ends));
    head.outputs = (uint8_t)(1 + draw(ends));
    head.hidden = (uint8_t)draw(SG_MLP_HIDDEN_MAX + 1);
    size_t n = sizeof head;
    for (int k = 0; k <= head.hidden; k++) {
        if (k < head.hidden)
            head.width[k] = (uint8_t)(1 + draw(widest));
        head.weight_bytes[k] = (uint8_t)(1 + draw(2));
        const unsigned columns = k == 0 ? head.inputs : head.width[k - 1];
        n += even(k == head.hidden ? head.outputs : head.width[k]) * (5 + columns * head.weight_bytes[k]);
    }
    head.length = (uint16_t)n;
    for (int j = 0; j < head.inputs && j < SG_MLP_INPUTS_MAX; j++) {
        head.input[j].offset = (uint16_t)draw(65536);
        head.input[j].gain_q8 = (uint16_t)draw(65536);
    }
    uint8_t *image = block(n);
    memcpy(image, &head, sizeof head);
    uint8_t *at = image + sizeof head;
    for (int k = 0; k <= head.hidden; k++) {
        const unsigned columns = k == 0 ? head.inputs : head.width[k - 1];
        unsigned left = even(k == head.hidden ? head.outputs : head.width[k]);
        while (left != 0) {
            const unsigned rows = left >= 4 ? 4 : 2;
            for (unsigned i = 0; i < rows; i++, at += 3) {
                const uint32_t bias = draw(0x300000) - 0x180000;
                for (int byte = 0; byte < 3; byte++)
                    at[byte] = (uint8_t)(bias >> (8 * byte));
            }
            for (unsigned i = 0; i < rows * columns; i++) {
                // 64 columns of at most 350, or of at most 128
                const unsigned w = head.weight_bytes[k] == 2 ? 32768 - 350 + draw(701) : draw(256);
                *at++ = (uint8_t)w;
                if (head.weight_bytes[k] == 2)
                    *at++ = (uint8_t)(w >> 8);
            }
            for (unsigned i = 0; i < 2 * rows; i++)
                *at++ = (uint8_t)draw(256);
            left -= rows;
        }
        if ((k == head.hidden ? head.outputs : head.width[k]) & 1)
            at[-1] = at[-2] = 0;
    }
    HOLDS(at == image + n, "length of an image");
    seal(image, n);
    *out = image;
    return n;
}

// Opens and, if it opens, evaluates. Returns the verdict.
static int try_image(const uint8_t *image, size_t n)
{
    struct sg_mlp_view view, untouched;
    memset(&view, 0x5A, sizeof view);
    memcpy(&untouched, &view, sizeof view);
    const int verdict = sg_mlp_open(&view, image, (uint32_t)n, 0);
    HOLDS(verdict <= 0 && verdict > -16, "verdict");
    refused[-verdict]++;
    if (verdict != SG_OK) {
        HOLDS(memcmp(&view, &untouched, sizeof view) == 0, "a refused image leaves the view alone");
        return verdict;
    }
    opened++;
    HOLDS(view.length <= n && view.scratch_words >= 2 && view.scratch_words <= SG_MLP_SCRATCH_MAX, "view");
    uint16_t *input = block(2u * view.inputs), *scratch = block(2u * view.scratch_words);
    int16_t *output = block(2u * view.outputs);
    for (int round = 0; round < 3; round++) {
        for (int j = 0; j < view.inputs; j++)
            input[j] = (uint16_t)(round == 0 ? 0 : round == 1 ? 65535 : draw(65536));
        memset(output, 0x80, 2u * view.outputs);
        uint8_t flags = 0x55;
        const int result = sg_mlp_predict(&view, input, scratch, output, &flags);
        int saturated = 0;
        for (int i = 0; i < view.outputs; i++) {
            HOLDS(output[i] >= -32767, "every output is written, and in its range");
            saturated |= output[i] == 32767 || output[i] == -32767;
        }
        HOLDS(flags == 0 || flags == SG_MLP_OUT_OF_RANGE, "flags");
        HOLDS(result == SG_OK || result == SG_E_RANGE, "result");
        HOLDS(result == SG_OK || (flags != 0 && saturated), "a saturated output is flagged");
    }
    free(input);
    free(scratch);
    free(output);
    return verdict;
}

static void every_byte(void)
{
    uint8_t *image;
    const size_t n = make_image(&image, 9, 8);
    HOLDS(try_image(image, n) == SG_OK, "a right image opens");
    for (size_t at = 0; at < n; at++) {
        const uint8_t kept = image[at];
        image[at] ^= (uint8_t)(1 + draw(255));
        HOLDS(try_image(image, n) < 0, "a changed byte is noticed");
        seal(image, n);
        try_image(image, n);
        image[at] = kept;
        seal(image, n);
    }
    for (size_t cut = 0; cut < n; cut += 1 + draw(20)) {    // in a block of the new size
        uint8_t *shorter = block(cut);
        memcpy(shorter, image, cut);
        HOLDS(try_image(shorter, cut) == SG_E_SHORT, "a short image is refused as short");
        free(shorter);
    }
    free(image);
}

static void big_image(void)
{
    uint8_t *image;
    const size_t n = make_image(&image, SG_MLP_WIDTH_MAX, 8);
    HOLDS(n <= SG_MLP_LENGTH_MAX, "longest image");
    HOLDS(try_image(image, n) == SG_OK, "a right image opens");
    for (uint32_t damage = 1 + draw(4); damage != 0; damage--)
        image[8 + draw(draw(2) ? 56 : (uint32_t)n - 8)] = (uint8_t)draw(256);
    seal(image, n);
    try_image(image, n);
    free(image);
}

// Shapes beyond the format's, with the length that goes with them.
static void big_counts(void)
{
    uint8_t *image;
    const size_t n = make_image(&image, draw(2) ? 80 : 20, draw(2) ? 12 : 8);
    int beyond = image[offsetof(struct sg_mlp_head, inputs)] > SG_MLP_INPUTS_MAX ||
                 image[offsetof(struct sg_mlp_head, outputs)] > SG_MLP_OUTPUTS_MAX;
    for (int k = 0; k < SG_MLP_HIDDEN_MAX; k++)
        beyond |= image[offsetof(struct sg_mlp_head, width) + (size_t)k] > SG_MLP_WIDTH_MAX;
    const int verdict = try_image(image, n);
    HOLDS(!beyond || verdict == SG_E_BOUNDS, "counts beyond the format's are refused");
    free(image);
}

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    state = strtoull(argv[1], NULL, 10) * 2654435761u + 1;
    const unsigned long rounds = strtoul(argv[2], NULL, 10);
    for (unsigned long i = 0; i < rounds; i++) {
        every_byte();
        for (int j = 0; j < 10; j++)
            big_image();
        for (int j = 0; j < 10; j++)
            big_counts();
    }
    printf("opened %lu short %lu magic %lu version %lu bounds %lu crc %lu\n", opened, refused[-SG_E_SHORT],
           refused[-SG_E_MAGIC], refused[-SG_E_VERSION], refused[-SG_E_BOUNDS], refused[-SG_E_CRC]);
    return 0;
}
