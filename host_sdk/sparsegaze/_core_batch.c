// SPDX-License-Identifier: Apache-2.0
// Loops over core functions for Python, where a call per sample would cost more than the sample. Host only.
#include <stddef.h>
#include <stdint.h>

#include "sg_err.h"
#include "sg_gp.h"
#include "sg_light.h"
#include "sg_mlp.h"
#include "sg_track.h"

// cdef begin
// sg_track_infer over n samples. features[n * 6]; raw_flags[n] or NULL for 0; out[n].
// Returns SG_OK, or SG_E_RANGE if any sample saturated.
int sg_batch_infer(const struct sg_model_view *view, const uint16_t *features, const uint8_t *raw_flags,
                   const struct sg_affine *recentre, struct sg_gaze *out, size_t n);

// sg_gp_predict over n samples. features[n * 6]; out[n]. Returns SG_OK, or SG_E_RANGE if any saturated.
int sg_batch_predict(const struct sg_model_view *view, const uint16_t *features, struct sg_gp_point *out,
                     size_t n);

// sg_light_add over n readings, and sg_light_features after every `repeats` of them.
// feature[n / repeats * 6]; flags[n / repeats] or NULL.
void sg_batch_light(struct sg_light *light, const struct sg_reading *reading, size_t n, size_t repeats,
                    uint16_t *feature, uint8_t *flags);

// sg_mlp_predict over n points. inputs[n * view->inputs]; outputs[n * view->outputs]; flags[n].
void sg_batch_mlp(const struct sg_mlp_view *view, const uint16_t *inputs, int16_t *outputs, uint8_t *flags,
                  size_t n);
// cdef end

int sg_batch_infer(const struct sg_model_view *view, const uint16_t *features, const uint8_t *raw_flags,
                   const struct sg_affine *recentre, struct sg_gaze *out, size_t n)
{
    int worst = SG_OK;
    for (size_t i = 0; i < n; i++) {
        const uint8_t flags = raw_flags == NULL ? 0 : raw_flags[i];
        const uint16_t *feature = features + i * SG_MODEL_CHANNELS;
        const int result = sg_track_infer(view, feature, flags, recentre, out + i);
        if (result != SG_OK)
            worst = result;
    }
    return worst;
}

int sg_batch_predict(const struct sg_model_view *view, const uint16_t *features, struct sg_gp_point *out,
                     size_t n)
{
    int worst = SG_OK;
    for (size_t i = 0; i < n; i++) {
        const int result = sg_gp_predict(view, features + i * SG_MODEL_CHANNELS, out + i);
        if (result != SG_OK)
            worst = result;
    }
    return worst;
}

void sg_batch_light(struct sg_light *light, const struct sg_reading *reading, size_t n, size_t repeats,
                    uint16_t *feature, uint8_t *flags)
{
    for (size_t i = 0, frame = 0; i < n; i++) {
        sg_light_add(light, reading + i);
        if ((i + 1) % repeats != 0)
            continue;
        const uint8_t seen = sg_light_features(light, feature + 6 * frame);
        if (flags != NULL)
            flags[frame] = seen;
        frame++;
    }
}

void sg_batch_mlp(const struct sg_mlp_view *view, const uint16_t *inputs, int16_t *outputs, uint8_t *flags,
                  size_t n)
{
    uint16_t scratch[SG_MLP_SCRATCH_MAX];
    for (size_t i = 0; i < n; i++)
        sg_mlp_predict(view, inputs + i * view->inputs, scratch, outputs + i * view->outputs, flags + i);
}
