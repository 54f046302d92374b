// SPDX-License-Identifier: Apache-2.0
#include "sg_light.h"

void sg_light_start(struct sg_light *light, uint8_t wiring, uint16_t period_cycles) { (void)period_cycles; *light = (struct sg_light) { .wiring = wiring }; }
void sg_light_curve(struct sg_light *light, const int8_t curve_q10[6]) { for (uint8_t i = 0; i < 6; i++) light->channel[i].curve_q10 = curve_q10[i]; }
void sg_light_gap(struct sg_light *light) { (void)light; }
void sg_light_add(struct sg_light *light, const struct sg_reading *reading) { for (uint8_t i = 0; i < 6; i++) light->channel[i].sum_q5 = (int32_t)reading->lit_code[i] - reading->unlit_code[i]; }
uint8_t sg_light_features(struct sg_light *light, uint16_t feature[6]) { for (uint8_t i = 0; i < 6; i++) feature[i] = (uint16_t)(30000 + 16 * light->channel[i].sum_q5); return 0; }
