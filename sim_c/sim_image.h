// SPDX-License-Identifier: Apache-2.0
//
// What a sensor sees, as an image: the paper's way to a response (image times window, summed), for comparison
// with the integrals of sim_scene.h and for looking at.
//
// Camera    a pinhole at the sensor's place. Square pixels in the tangent of the angle off the sensor's axis,
//           as many as `pixels` over +-half_width_sigmas of its window on both sides; the value of a pixel is
//           that at its centre. Row 0 is on top; up is the head's +y. Seen from in front of a face: a right
//           eye's temple (+x) is on the left.
// Radiance  of every pixel for one emitter alone, per unit of its axial intensity, 1/mm^2. The sum over
//           pixels of radiance * window * solid angle is the response of sim_scene.h, but for: pixels (edges
//           and narrow glints alias), the window beyond the image's border, and the sensor's lens, which a
//           pinhole has not: the skin's and sclera's cosine is not rounded at the horizon by the sensor's
//           lens. The glint's lobe is widened by both lenses all the same. Light that reaches a spot of the
//           iris by two ways (sensors beyond 65 degrees off the eye's axis) is all seen.
// Eye       the analytic surface, found by steps that cannot pass it and a bracketed root; the iris by
//           Snell's law on the way in. Face: Embree's hits on a mesh of its height field, moved onto the
//           height field itself.
#ifndef SIM_IMAGE_H
#define SIM_IMAGE_H

#include "sim_scene.h"

// cdef begin
// Terms besides SIM_TERM_*; APART: each in an image of its own.
enum { SIM_IMAGE_GLINT = 8, SIM_IMAGE_ALL = 15, SIM_IMAGE_APART = 16, SIM_IMAGE_MAX_PIXELS = 4096 };

// What hides what.
//   SOFT  as sim_scene.h has it: a lens of finite size sets behind the face's horizon and behind the corneal
//         bulge. A ray goes on behind what it meets, because part of the lens still sees it.
//   RAYS  the first thing that a ray meets, and shadow rays to each emitter's centre: Embree for the face,
//         steps along the eye's own surface for the eye. The lids' margins are soft in both.
enum { SIM_OCCLUSION_SOFT = 0, SIM_OCCLUSION_RAYS = 1 };

struct sim_image;

// Prepare the images of one sensor: what depends on neither gaze nor lids (rays against the face, its
// shadows).
//   scene       must outlive the image
//   emitters    [n_emitters] numbers of those whose light is wanted
// Returns the image, or NULL with one line in error. Cost: 1 us a pixel and emitter, 0.1 s for the mesh.
struct sim_image *sim_image_open(const struct sim_scene *scene, int sensor, const int *emitters,
                                 int n_emitters, int pixels, double half_width_sigmas, int occlusion,
                                 char *error, size_t error_bytes);
void sim_image_close(struct sim_image *image);  // NULL allowed

// radiance [n_emitters][pixels][pixels] receives the sum of the chosen terms; with SIM_IMAGE_APART
// [face, sclera, iris, glint][n_emitters][pixels][pixels]. Reentrant.
// Returns 0, or -1 for a state outside sim_scene_smooth()'s.
int sim_image_render(const struct sim_image *image, double azimuth_deg, double elevation_deg,
                     double pupil_mm, double lid_opening, int terms, double *radiance);
// cdef end

// The camera alone, shared with the other renderer.
struct sim_camera {
    double position[3], aim[3], right[3], up[3];  // head frame, unit vectors
    double half, pitch, per_tan2;                 // tangents; 1 / (2 tan^2 sigma)
    int pixels, site;
};

// Returns 0, or -1 with a reason.
int sim_camera_set(struct sim_camera *camera, const struct sim_scene *scene, int sensor, const int *emitters,
                   int n_emitters, int pixels, double half_width_sigmas, char *error, size_t error_bytes);

// Variance that the lenses at two sites add to the glint's lobe.
double sim_image_widen(const struct sim_scene *scene, const double axes[9], int site);

// 0 when sim_scene_smooth() would take this state.
int sim_image_bad_state(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                        double pupil_mm, double lid_opening);

#endif
