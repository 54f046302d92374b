// SPDX-License-Identifier: Apache-2.0
//
// What the halves of the image renderer share: an image, and one look at it. Not for callers.
#ifndef SIM_IMAGE_INSIDE_H
#define SIM_IMAGE_INSIDE_H

#include "sim_image.h"
#include "sim_image_face.h"
#include "sim_inside.h"

enum { SIM_IMAGE_LAYERS = 8 };  // surfaces behind each other that one ray may meet

// Skin in one pixel: what the lids' pose does not change.
struct sim_image_skin {
    int pixel, lid;  // lid: an open eye may take its place
    double alpha, beta, rho;
};

struct sim_image {
    const struct sim_scene *scene;
    struct sim_camera camera;
    int n_emitters, occlusion;
    int emitters[SIM_MAX_PORTS];
    struct sim_image_face *closed, *relief;  // kept where rays decide
    struct sim_image_skin *skin;
    double *skin_light;  // [n_skin][n_emitters] radiance with the lids closed
    int n_skin, room;
};

enum { SIM_PART_FACE, SIM_PART_SCLERA, SIM_PART_IRIS, SIM_PART_GLINT };

// One state, and the pixel at hand.
struct sim_image_look {
    const struct sim_image *image;
    double axes[9], camera_eye[3], sites_eye[2 * SIM_MAX_PORTS][3];  // eye frame
    double pupil_radius, widen[2 * SIM_MAX_PORTS];
    struct sim_lid lid;
    int terms, pixel;
    double *radiance;
};

static inline void sim_image_to_eye(const double axes[9], const double head[3], double eye[3]) {
    for (int j = 0; j < 3; ++j) eye[j] = axes[j] * head[0] + axes[3 + j] * head[1] + axes[6 + j] * head[2];
}

static inline void sim_image_to_head(const double axes[9], const double eye[3], double head[3]) {
    for (int i = 0; i < 3; ++i)
        head[i] = axes[3 * i] * eye[0] + axes[3 * i + 1] * eye[1] + axes[3 * i + 2] * eye[2];
}

// Light of one part in the pixel at hand.
static inline void sim_image_add(const struct sim_image_look *look, int part, int e, double light) {
    size_t n = (size_t)look->image->camera.pixels, plane = (size_t)e;
    if (look->terms & SIM_IMAGE_APART) plane += (size_t)(part * look->image->n_emitters);
    look->radiance[plane * n * n + (size_t)look->pixel] += light;
}

// Unit vector of a pixel's centre, head frame.
void sim_image_ray(const struct sim_camera *camera, int pixel, double ray[3]);

// Sclera, iris and glint of all pixels.
void sim_image_add_eye(struct sim_image_look *look);

#endif
