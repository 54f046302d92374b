// SPDX-License-Identifier: Apache-2.0
//
// The images of sim_image.h by another way: an OpenGL 3.3 fragment shader (sim_osmesa.glsl) that Mesa runs on
// the processor, in 32-bit floats. libOSMesa is opened when it is first wanted; nothing here needs it to
// build, link or load.
//
// Framebuffer   RGBA32F: face, sclera, iris and glint of one emitter, times SIM_OSMESA_GAIN, so that most of
//               what is seen lies between 0.01 and 10,000: a framebuffer that clamps at 1, or one of 16 bits,
//               would show. Divided out again when read.
// Threads       a context belongs to one thread at a time; Mesa's rasteriser uses all cores
//               (LP_NUM_THREADS=0: only the caller).
#ifndef SIM_OSMESA_H
#define SIM_OSMESA_H

#include "sim_image.h"

// cdef begin
struct sim_osmesa;

// Prepare the images of one sensor. Arguments as sim_image_open(). Returns NULL with one line in error:
// "libOSMesa is not there" where it is not.
struct sim_osmesa *sim_osmesa_open(const struct sim_scene *scene, int sensor, const int *emitters,
                                   int n_emitters, int pixels, double half_width_sigmas, char *error,
                                   size_t error_bytes);
void sim_osmesa_close(struct sim_osmesa *osmesa);  // NULL allowed

// radiance [n_emitters][pixels][pixels][4]: face, sclera, iris, glint.
// Returns 0, or -1 for a state outside sim_scene_smooth()'s, -2 when OpenGL fails.
int sim_osmesa_render(struct sim_osmesa *osmesa, double azimuth_deg, double elevation_deg, double pupil_mm,
                      double lid_opening, float *radiance);
// cdef end

#endif
