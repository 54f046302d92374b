// SPDX-License-Identifier: Apache-2.0
// Part of sg_gp: does any gaze explain these features? The formulas are in sg_model.h, under "Trust".
#ifndef SG_GP_TRUST_H
#define SG_GP_TRUST_H

#include "sg_gp.h"
#include "sg_gp_loop.h"

// Judge a point whose angles are known.
//
//   sum     scaled features of the point
//   point   deg_q7 and flags given; flags may gain SG_GP_OUT_OF_RANGE, doubt and sigma_log2_q4 are written
void sg_gp_trust(const struct sg_model_view *view, const struct sg_gp_sum *sum, struct sg_gp_point *point);

#endif
