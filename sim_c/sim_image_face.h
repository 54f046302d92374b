// SPDX-License-Identifier: Apache-2.0
//
// The face as a camera meets it: Embree's rays against a mesh of the height field, and the horizon that the
// height field makes. Not for callers.
#ifndef SIM_IMAGE_FACE_H
#define SIM_IMAGE_FACE_H

#include <stddef.h>

#include "sim_eye.h"

struct sim_image_face;

// What a ray meets.
struct sim_image_hit {
    double point[3], normal[3];  // head frame, mm; outward unit normal
    double beyond;               // where to look for the next one, mm along the ray
};

// relief_only: the face without the lids' bulge, as it stands before the eye. NULL with a reason on failure.
struct sim_image_face *sim_image_face_open(const struct sim_person *person, int relief_only, char *error,
                                           size_t error_bytes);
void sim_image_face_close(struct sim_image_face *face);

// The first place beyond t_from where a ray (unit direction) enters the face. Returns 0 when there is none.
int sim_image_face_hit(const struct sim_image_face *face, const double from[3], const double direction[3],
                       double t_from, struct sim_image_hit *hit);

// Whether the mesh blocks the way between two points.
int sim_image_face_blocked(const struct sim_image_face *face, const double from[3], const double to[3]);

// Share of a lens at `site` that a place of the skin sees, relative to what its own tangent plane leaves.
double sim_image_face_share(const struct sim_image_face *face, const struct sim_image_hit *at,
                            const double site[3], double radius);

#endif
