// SPDX-License-Identifier: Apache-2.0
//
// Points in batches: loops that the compiler turns into vector code, and what their bodies are made of. No
// branches in there, no calls into libm but sqrt. Without contraction of products and sums (strict C11) every
// width of vector gives the same bits.
#ifndef SIM_WIDE_H
#define SIM_WIDE_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "sim_inside.h"

// A function of such loops: compiled for several widths, the processor's chosen when the module is loaded.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define SIM_WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define SIM_WIDE
#endif
// One turn of the loop reads nothing that another has written.
#if defined(__GNUC__) && !defined(__clang__)
#define SIM_EACH(p, n) _Pragma("GCC ivdep") for (int p = 0; p < (n); ++p)
#else
#define SIM_EACH(p, n) for (int p = 0; p < (n); ++p)
#endif
#define SIM_INLINE static inline __attribute__((always_inline))

enum { SIM_LANES = 8, SIM_BATCH = 64, SIM_COLUMNS = 17 };

// Loops run over whole vectors: what lies between n and this must be finite and have weight 0.
static inline int sim_whole(int n) {
    return (n + SIM_LANES - 1) / SIM_LANES * SIM_LANES;
}

SIM_INLINE double sim_wide_max(double a, double b) {
    return a > b ? a : b;
}

SIM_INLINE double sim_wide_min(double a, double b) {
    return a < b ? a : b;
}

// sim_step() without branches.
SIM_INLINE double sim_wide_step(double t) {
    double u = sim_wide_min(sim_wide_max(t, 0.0), 1.0);
    return u * u * u * (10 + u * (6 * u - 15));
}

// exp(-t) for t in 0..700, to 1e-13 relative.
SIM_INLINE double sim_wide_decay(double t) {
    const double round = 6755399441055744.0;  // 1.5 * 2^52: adding it leaves whole numbers in the low bits
    double shifted = t * 1.4426950408889634 + round, k = shifted - round;
    double f = k * 0.693147180369123816490 - t + k * 1.90821492927058770002e-10;
    double p = 1.0 / 3628800;
    p = p * f + 1.0 / 362880;
    p = p * f + 1.0 / 40320;
    p = p * f + 1.0 / 5040;
    p = p * f + 1.0 / 720;
    p = p * f + 1.0 / 120;
    p = p * f + 1.0 / 24;
    p = p * f + 1.0 / 6;
    p = p * f + 0.5;
    p = p * f + 1;
    p = p * f + 1;
    uint64_t bits;
    double power;
    memcpy(&bits, &shifted, sizeof bits);
    bits = (UINT64_C(1023) - bits) << 52;
    memcpy(&power, &bits, sizeof power);
    return p * power;
}

// Angle of (x, y) from the x axis, given their length; to 1e-11 where |angle| < 100 degrees.
SIM_INLINE double sim_wide_angle(double y, double x, double length) {
    double u = y / (length + x);
    u = u / (1 + sqrt(1 + u * u));
    double v = u * u, p = 1.0 / 29;
    p = 1.0 / 27 - v * p;
    p = 1.0 / 25 - v * p;
    p = 1.0 / 23 - v * p;
    p = 1.0 / 21 - v * p;
    p = 1.0 / 19 - v * p;
    p = 1.0 / 17 - v * p;
    p = 1.0 / 15 - v * p;
    p = 1.0 / 13 - v * p;
    p = 1.0 / 11 - v * p;
    p = 1.0 / 9 - v * p;
    p = 1.0 / 7 - v * p;
    p = 1.0 / 5 - v * p;
    p = 1.0 / 3 - v * p;
    p = 1 - v * p;
    return 4 * u * p;
}

// sim_window_weight() without branches, at a cosine off the axis.
SIM_INLINE double sim_wide_window(double c, double per_tan2) {
    double safe = sim_wide_max(c, 0.03), square = safe * safe;
    double t = (1 - square) / square * per_tan2;
    double w = sim_wide_decay(sim_wide_min(sim_wide_max(t, 0.0), 41.0));
    return (c < 0.03) | (t > 40) ? 0.0 : w;
}

// A place on the eye where a narrow window or a near site asks for close points.
struct sim_focus {
    double alpha, beta, reach;  // direction and radius, radians
    double scale_mm;            // standard deviation of what is narrow there
};

// Distance from a margin that a standing height hides, upward (sign 1) or downward (-1), along a unit vector
// with the given parts along the radius and up: the positive part of the slope toward the margin, rounded so
// that it is smooth where the ray is along the normal.
SIM_INLINE double sim_wide_hidden(double height, double out, double tangent, double sign) {
    double t = tangent / sim_wide_max(out, 0.02);
    return height * (sqrt(t * t + 0.01) + sign * t) / 2;
}

// sim_lid_open_toward() without branches and lashes.
SIM_INLINE double sim_wide_open(double thickness, double per_softness, double above, double below, double out,
                                double tangent) {
    double t = tangent / sim_wide_max(out, 0.02), size = sqrt(t * t + 0.01), half = thickness / 2;
    return sim_wide_step((above - half * (size + t)) * per_softness) *
           sim_wide_step((below - half * (size - t)) * per_softness);
}

// What the upper lashes leave of it.
SIM_INLINE double sim_wide_lashes(const struct sim_lid *lid, double above, double out, double tangent) {
    double hidden = sim_wide_hidden(lid->lash_length, out, tangent, 1);
    return 1 - lid->lash_opacity * (1 - sim_wide_step((above - hidden) / lid->softness));
}

// What the sites and ports get from a batch of points: scratch memory of one call.
struct sim_light {
    double *memory;
    double *away;                     // [site][3][SIM_BATCH] unit vectors, head frame
    double *transfer;                 // [site][SIM_BATCH]
    double *alpha, *beta, *distance;  // [site][SIM_BATCH] as the lids see the point, for the iris
    double *out, *tangent;            // [site][SIM_BATCH] parts of `away` along the radius and up
    double *part;                     // [sensors + emitters][SIM_BATCH] transfer times window
    double *shown;                    // the same behind one pose of the lids
    double *open;                     // [site][SIM_BATCH] how open that pose is
    double *survey;                   // [2][SIM_COLUMNS][site] how well rows see the sites
    const struct sim_site **order;    // the sites by place: breaks must not depend on how they are numbered
    struct sim_focus *foci;           // of the scene, those of less than a few mm
    int n_foci;
};

// Returns 0, or -1 for lack of memory. sim_light_close() in either case.
int sim_light_open(struct sim_light *light, const struct sim_scene *scene);
void sim_light_close(struct sim_light *light);

// part = transfer times every port's window, from `away` and `transfer` of n points.
void sim_light_windows(const struct sim_scene *scene, struct sim_light *light, int n);

// out[sensor][emitter] += sum over n points of weight * part * part. part: `part` or `shown`.
void sim_light_pairs(const struct sim_scene *scene, const double *part, const double *weight, int n,
                     double *out);

// Ascending places of a row between which it is integrated piece by piece.
struct sim_breaks {
    int n;
    double at[40];
};

// One more, unless it is outside or nearer than `apart` to another.
void sim_break_add(struct sim_breaks *breaks, double at, double apart);

// Samples of a row, evenly from end to end, and where a value over them passes 0 upward for the first time,
// from `first` on in the given direction (in samples; the last one if never).
enum { SIM_SAMPLES = 16 };
double sim_crossing(const double *value, int first, int direction);

// The greatest over the samples of the lesser of two values.
double sim_most_of_both(const double *a, const double *b);

// Breaks where a value changes sign between samples at which both `lower` and `upper` are not below 0;
// direction 1 or -1: only where it falls, going that way.
void sim_break_changes(struct sim_breaks *breaks, const double *value, const double *lower,
                       const double *upper, int direction, double from, double step);

// Places, over columns evenly from -half to half, between which a value (every stride-th) is not below 0.
// Returns 0 if there are none.
int sim_positive(const double *value, int stride, double half, double *from, double *to);

// Gauss's rule for a piece that wants so many nodes: nodes, of equal parts.
int sim_nodes_for(double want, int *parts);

// Points of the eye's surface on their way: directions and weights, then places and normals, head frame.
struct sim_surface {
    int n;
    double row[2][SIM_BATCH];  // sine and cosine of alpha
    double alpha[SIM_BATCH], beta[SIM_BATCH], weight[SIM_BATCH];
    double point[3][SIM_BATCH], normal[3][SIM_BATCH], radial[3][SIM_BATCH], up[3][SIM_BATCH];
    double above[SIM_BATCH], below[SIM_BATCH];
};

// Points and normals from directions; the weights become areas of white (albedo 1/sr). axes: of the eye.
void sim_surface_place(const struct sim_eye *eye, const struct sim_lid *lid, const double axes[9],
                       double albedo, struct sim_surface *s);

// One site: unit vectors to it, away [3][SIM_BATCH], and the irradiance per intensity that reaches the points
// past lids and cornea. centre: of the sphere that the cornea is here, head frame.
void sim_surface_reach(const struct sim_scene *scene, const struct sim_site *site, const double centre[3],
                       const struct sim_lid *lid, const struct sim_surface *s, double *away,
                       double *transfer);

// The same site's light through the lashes.
void sim_surface_dim(const struct sim_lid *lid, const struct sim_surface *s, const double *away,
                     double *transfer);

// The sclera, of one lid pose: out [sensors][emitters]. axes: of the eye, as sim_eye_orient().
void sim_add_sclera(const struct sim_scene *scene, struct sim_light *light, const double axes[9],
                    double elevation_deg, double opening, double *out);

// The iris, for all pupils (ascending) and lid poses: out [n_pupils][n_lids][sensors][emitters]. Returns 0,
// or -1 for lack of memory.
int sim_add_iris(const struct sim_scene *scene, struct sim_light *light, const double axes[9],
                 double elevation_deg, const double *pupil_mm, int n_pupils, const double *lid_opening,
                 int n_lids, double *out);

#endif
