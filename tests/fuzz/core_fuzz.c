// SPDX-License-Identifier: Apache-2.0
// Hostile bytes for everything of the core that reads what others wrote, to be built with
// -fsanitize=address,undefined. Every input lies in a heap block of exactly its size, so that one byte too
// far is seen.
//
//   core_fuzz SEED ROUNDS      prints one line of counts; a broken invariant aborts with its name
//
// Invariants: decode never returns more than 64 nor writes beyond; what decodes re-encodes to the same bytes;
// a receiver is back in step one delimiter after anything; whatever sg_model_open accepts can be predicted
// from, with any feature; nothing is written to a view that was refused; no reading takes an exposure beyond
// its limits.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sg_err.h"
#include "sg_expose.h"
#include "sg_gp.h"
#include "sg_health.h"
#include "sg_light.h"
#include "sg_link.h"
#include "sg_model.h"
#include "sg_track.h"
#include "sg_wire.h"

#define HOLDS(condition, name)                             \
    do {                                                   \
        if (!(condition)) {                                \
            fprintf(stderr, "broken invariant: %s\n", name); \
            abort();                                       \
        }                                                  \
    } while (0)

static uint64_t state;

static uint32_t draw(uint32_t below)
{
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (uint32_t)((state >> 33) % below);
}

static void fill(uint8_t *data, size_t n)
{
    const uint32_t mode = draw(4);  // anything, few zeros, many zeros, small codes as COBS likes them
    for (size_t i = 0; i < n; i++) {
        data[i] = (uint8_t)draw(256);
        if (mode == 1 && data[i] == 0)
            data[i] = 1;
        if (mode == 2 && draw(3) == 0)
            data[i] = 0;
        if (mode == 3)
            data[i] = (uint8_t)(1 + data[i] % 20);
    }
}

static uint8_t *block(size_t n)
{
    uint8_t *data = malloc(n ? n : 1);
    HOLDS(data != NULL, "memory");
    return data;
}

static unsigned long decoded, opened, refused[16];

static void fuzz_decode(void)
{
    const size_t n = draw(100);
    uint8_t *frame = block(n);
    uint8_t *body = block(SG_WIRE_BODY_MAX);
    struct sg_head head;
    fill(frame, n);
    if (draw(2)) {  // a good frame, perhaps with one fault
        free(frame);
        uint8_t content[SG_WIRE_BODY_MAX + 16], whole[sizeof content + 9];
        const size_t content_bytes = draw(sizeof content + 1);      // sometimes longer than there is room for
        fill(content, content_bytes);
        head = (struct sg_head){ .seq = (uint16_t)draw(65536), .type = (uint8_t)draw(256), .flags = 0 };
        const int length =
            sg_wire_encode_ring(&head, content, (uint8_t)content_bytes, whole, sizeof whole, 0) - 1;
        HOLDS(length == (int)content_bytes + 7, "encoded length");
        uint8_t *exact = block((size_t)length);
        memcpy(exact, whole, (size_t)length);
        frame = exact;
        const uint32_t fault = draw(3);
        if (fault == 1)
            exact[draw((uint32_t)length)] = (uint8_t)draw(256);
        const int cut = fault == 2 ? (int)draw((uint32_t)length) : length;
        const int got = sg_wire_decode(frame, (size_t)cut, &head, body);
        HOLDS(fault != 0
                  || (content_bytes > SG_WIRE_BODY_MAX ? got == SG_E_BOUNDS
                      : got == (int)content_bytes && memcmp(body, content, content_bytes) == 0),
              "round trip");
        decoded += got >= 0;
    } else {
        uint8_t sent[100];
        memcpy(sent, frame, n);
        const int got = sg_wire_decode(frame, n, &head, body);
        HOLDS(got <= SG_WIRE_BODY_MAX, "body length");
        if (got >= 0) {
            uint8_t again[SG_WIRE_FRAME_MAX];
            const int m = sg_wire_encode(&head, body, (size_t)got, again);
            HOLDS(m == (int)n + 1 && memcmp(again, sent, n) == 0, "one encoding per packet");
            decoded++;
        }
    }
    free(frame);
    free(body);
}

static void fuzz_link(void)
{
    static struct sg_link_rx rx;  // goes on from round to round, as on a device
    struct sg_head head;
    uint8_t body[SG_WIRE_BODY_MAX], noise[300], frame[SG_WIRE_FRAME_MAX];
    size_t used;
    const size_t n = draw(sizeof noise);
    fill(noise, n);
    for (size_t at = 0; at < n; at += used) {
        const int got = sg_link_feed(&rx, noise + at, n - at, &used, &head, body);
        HOLDS(used > 0 && used <= n - at && got <= SG_WIRE_BODY_MAX, "progress of the receiver");
    }
    head = (struct sg_head){ .seq = (uint16_t)draw(65536), .type = 1, .flags = 0 };
    const uint16_t seq = head.seq;
    const int m = sg_wire_encode(&head, noise, n % (SG_WIRE_BODY_MAX + 1), frame);
    sg_link_receive(&rx, 0, &head, body);
    const int got = sg_link_feed(&rx, frame, (size_t)m, &used, &head, body);
    HOLDS(got == (int)(n % (SG_WIRE_BODY_MAX + 1)) && head.seq == seq && used == (size_t)m, "back in step");
}

static void put32(uint8_t *at, uint32_t value)
{
    for (int i = 0; i < 4; i++)
        at[i] = (uint8_t)(value >> (8 * i));
}

static void put16(uint8_t *at, uint32_t value)
{
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

#define HEAD(field) offsetof(struct sg_model_head, field)
#define TRUST(field) (SG_MODEL_PAGE + offsetof(struct sg_model_trust, field))

// Trust page of a model with wild content: every value that the format allows.
static void make_trust(uint8_t *image, uint8_t guards, const uint8_t nodes[2])
{
    for (uint8_t i = 0; i < guards; i++) {
        uint8_t *guard = image + TRUST(guard) + i * sizeof(struct sg_model_guard);
        fill(guard, sizeof(struct sg_model_guard));
        const uint32_t width = draw(65536), low = draw(65536 - width);      // from -32768 on
        put16(guard + offsetof(struct sg_model_guard, base), draw(32769) - 16384);
        put16(guard + offsetof(struct sg_model_guard, low), low - 32768);
        put16(guard + offsetof(struct sg_model_guard, high), low + width - 32768);
    }
    for (int i = 0; i < 2; i++) {
        put16(image + TRUST(origin_deg_q7) + 2 * i, draw(32769) - 16384);
        image[TRUST(scale) + i] = (uint8_t)(1 + draw(255));
        image[TRUST(nodes) + i] = nodes[i];
    }
    put16(image + TRUST(limit), draw(65536));
    image[TRUST(guards)] = guards;
    image[TRUST(sigma_gain)] = (uint8_t)draw(256);
}

// A model that is right in form, with wild content, then some damage, then often a CRC that fits the damage.
static size_t make_model(uint8_t **out)
{
    const uint8_t guards = (uint8_t)draw(SG_MODEL_GUARDS + 1);
    uint8_t nodes[2] = { 0, 0 };
    if (draw(2))
        for (int i = 0; i < 2; i++)
            nodes[i] = (uint8_t)(2 + draw(draw(4) ? 8 : SG_MODEL_NODES_MAX - 1));
    const size_t grid = (size_t)nodes[0] * nodes[1] * SG_MODEL_NODE_BYTES;
    const size_t room = SG_MODEL_SLOT_BYTES - SG_MODEL_HEAD_BYTES < grid
                            ? 0 : (SG_MODEL_SLOT_BYTES - SG_MODEL_HEAD_BYTES - grid) / SG_MODEL_RECORD_BYTES;
    const uint8_t vectors = (uint8_t)(1 + draw(draw(8) || room < 20 ? 20 : (uint32_t)room));
    const size_t n = SG_MODEL_HEAD_BYTES + grid + (size_t)vectors * SG_MODEL_RECORD_BYTES;
    uint8_t *image = block(n);
    memset(image, 0, n);
    put32(image, SG_MODEL_MAGIC);
    put32(image + HEAD(length), (uint32_t)n);
    fill(image + HEAD(trend), HEAD(version) - HEAD(trend));
    for (int i = 0; i < 2; i++)
        put32(image + HEAD(bias) + 4 * i, draw(0x80000001u) - 0x40000000u);
    image[HEAD(version)] = SG_MODEL_VERSION;
    image[HEAD(vectors)] = vectors;
    image[HEAD(channels)] = SG_MODEL_CHANNELS;
    image[HEAD(weight_frac_bits)] = (uint8_t)(5 + draw(5));
    make_trust(image, guards, nodes);
    for (size_t at = SG_MODEL_HEAD_BYTES; at < SG_MODEL_HEAD_BYTES + grid; at += SG_MODEL_NODE_BYTES) {
        fill(image + at, guards);
        image[at + SG_MODEL_GUARDS] = (uint8_t)(1 + draw(255));
    }
    for (size_t at = SG_MODEL_HEAD_BYTES + grid; at < n; at += SG_MODEL_RECORD_BYTES) {
        uint32_t c2 = 31;
        fill(image + at + 2, SG_MODEL_RECORD_BYTES - 2);
        for (int j = 0; j < SG_MODEL_CHANNELS; j++)
            c2 += (uint32_t)image[at + 2 + j] * image[at + 2 + j];
        put16(image + at, c2 >> 5);
    }
    for (uint32_t damage = draw(3); damage != 0; damage--)
        image[draw(draw(2) ? SG_MODEL_HEAD_BYTES : (uint32_t)n)] ^= (uint8_t)(1u << draw(8));
    if (draw(8))
        put32(image + HEAD(crc), sg_model_crc32(0, image + 8, n - 8));
    *out = image;
    return n;
}

static void fuzz_model(void)
{
    uint8_t *image;
    size_t n;
    if (draw(4) == 0) {
        n = draw(600);
        image = block(n);
        fill(image, n);
        if (n >= 4 && draw(2))
            put32(image, SG_MODEL_MAGIC);
    } else {
        n = make_model(&image);
    }
    if (draw(6) == 0 && n > 0) {  // cut short, in a block of the new size
        n = draw((uint32_t)n);
        uint8_t *shorter = block(n);
        memcpy(shorter, image, n);
        free(image);
        image = shorter;
    }
    struct sg_model_view view, untouched;
    memset(&view, 0x5A, sizeof view);
    memcpy(&untouched, &view, sizeof view);
    const int verdict = sg_model_open(&view, image, (uint32_t)n, 0);
    HOLDS(verdict <= 0 && verdict > -16, "verdict");
    if (verdict == SG_OK) {
        opened++;
        HOLDS(view.length <= n, "length inside the room");
        for (int i = 0; i < 4; i++) {
            uint16_t feature[6];
            for (int j = 0; j < 6; j++)
                feature[j] = (uint16_t)(draw(3) ? draw(65536) : (draw(2) ? 65535 : 0));
            struct sg_affine recentre;
            for (int j = 0; j < 2; j++)
                recentre.offset_deg_q7[j] = (int16_t)(draw(65536) - 32768);
            for (int j = 0; j < 4; j++)
                recentre.gain_q9[j] = (int8_t)(draw(256) - 128);
            struct sg_gaze gaze;
            const int result = sg_track_infer(&view, feature, (uint8_t)draw(256), &recentre, &gaze);
            HOLDS(result == SG_OK || result == SG_E_RANGE, "result of inference");
            HOLDS(result == SG_OK || !(gaze.flags & SG_FLAG_VALID), "a saturated gaze is not valid");
        }
    } else {
        refused[-verdict]++;
        HOLDS(memcmp(&view, &untouched, sizeof view) == 0, "a refused image leaves the view alone");
    }
    free(image);
}

static void any_exposures(uint16_t cycles[SG_LIGHT_CHANNELS])
{
    for (int i = 0; i < SG_LIGHT_CHANNELS; i++)
        cycles[i] = (uint16_t)(draw(4) ? 64 + draw(5200) : draw(65536));
}

// Readings that no port would give, in any order with everything that may come between them.
static void fuzz_sense(void)
{
    struct sg_light light;
    struct sg_expose expose;
    struct sg_health health;
    uint16_t cycles[SG_LIGHT_CHANNELS], most[SG_LIGHT_CHANNELS], feature[SG_LIGHT_CHANNELS];
    any_exposures(cycles);
    any_exposures(most);
    sg_light_start(&light, (uint8_t)draw(2), (uint16_t)draw(65536));
    sg_expose_start(&expose, cycles, most);
    sg_health_start(&health);
    for (int i = 0; i < 200; i++) {
        struct sg_reading reading;
        const uint32_t most_code = draw(2) ? 1024 : 65536;
        for (int j = 0; j < SG_LIGHT_CHANNELS; j++) {
            reading.lit_code[j] = (uint16_t)draw(most_code);
            reading.unlit_code[j] = (uint16_t)(draw(2) ? reading.lit_code[j] : draw(most_code));
            reading.exposure_cycles[j] = draw(4) ? expose.led[j].exposure_cycles : (uint16_t)draw(65536);
            reading.late_lit_cycles[j] = (uint8_t)(draw(4) ? 0 : draw(256));
            reading.late_unlit_cycles[j] = (uint8_t)(draw(4) ? 0 : draw(256));
        }
        reading.held_code = (uint16_t)(draw(4) ? 0 : draw(most_code));
        sg_light_add(&light, &reading);
        if (draw(16) == 0) {
            int8_t curve[SG_LIGHT_CHANNELS];
            for (int j = 0; j < SG_LIGHT_CHANNELS; j++)
                curve[j] = (int8_t)(draw(256) - 128);
            sg_light_curve(&light, curve, (int8_t)-(int)draw(129));
        }
        if (draw(16) == 0)
            sg_light_gap(&light);
        if (draw(4) != 0 || i % SG_LIGHT_REPEATS_MAX == SG_LIGHT_REPEATS_MAX - 1) {
            const uint8_t flags = sg_light_features(&light, feature);
            HOLDS((flags & ~(SG_LIGHT_SATURATED | SG_LIGHT_STARVED)) == 0, "flags of the features");
            struct sg_health_sight sight = { .lit_code = reading.lit_code[i % 6], .feature = feature[i % 6],
                                             .unlit_code = reading.unlit_code[i % 6],
                                             .before_code = (uint16_t)draw(1024),
                                             .exposure_cycles = reading.exposure_cycles[i % 6],
                                             .most_cycles = most[i % 6], .offset = (uint16_t)draw(65536),
                                             .gain_q12 = (uint16_t)draw(65536) };
            sg_health_look(&health, (uint8_t)(i % 6), &sight);
            HOLDS(health.fault[i % 6] < 16, "faults have names");
        }
        sg_expose_cycle(&expose, &reading, (uint8_t)(i & 1));
        for (int j = 0; j < SG_LIGHT_CHANNELS; j++) {
            const uint16_t now = expose.led[j].exposure_cycles;
            HOLDS(now >= SG_EXPOSE_MIN_CYCLES && now <= SG_EXPOSE_MAX_CYCLES, "limits of an exposure");
        }
    }
}

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    state = strtoull(argv[1], NULL, 10) * 2654435761u + 1;
    const unsigned long rounds = strtoul(argv[2], NULL, 10);
    for (unsigned long i = 0; i < rounds; i++) {
        fuzz_decode();
        fuzz_link();
        fuzz_model();
        if (i % 16 == 0)
            fuzz_sense();
    }
    printf("decoded %lu opened %lu short %lu magic %lu version %lu bounds %lu crc %lu\n", decoded, opened,
           refused[-SG_E_SHORT], refused[-SG_E_MAGIC], refused[-SG_E_VERSION], refused[-SG_E_BOUNDS],
           refused[-SG_E_CRC]);
    return 0;
}
