// SPDX-License-Identifier: Apache-2.0
#include "sg_health.h"

void sg_health_start(struct sg_health *health) { *health = (struct sg_health) { .fault = { 0 } }; }
uint8_t sg_health_look(struct sg_health *health, uint8_t channel, const struct sg_health_sight *sight) { (void)health; (void)channel; (void)sight; return 0; }
