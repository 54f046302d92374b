// SPDX-License-Identifier: Apache-2.0
#include "sim_face.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846
#define RADIANS (PI / 180)

static const double BLEND = 3;  // reach of the smooth maximum of bulge and orbit, mm
static const double VIEW_ALPHA = 85 * RADIANS, VIEW_BETA = 70 * RADIANS;
static const double SAMPLE_MM = 0.7;  // along a ray, seen from the front; the face has no finer features
static const double TINY = 1e-6;      // fraction of a ray below which gap(u) / u would be rounding noise

void sim_relief_init(struct sim_relief *relief, const struct sim_person *person) {
    double big = person->lid_radius_mm, edge = 0.9 * big;
    relief->radius = big;
    relief->edge = edge;
    relief->edge_height = sqrt(big * big - edge * edge);
    relief->edge_slope = edge / relief->edge_height;
    relief->brow = person->brow_mm;
    relief->cheek = person->cheek_mm;
    relief->nose = person->nose_mm;
}

static double cap_height(const struct sim_relief *f, double r2) {
    if (r2 < f->edge * f->edge) return sqrt(f->radius * f->radius - r2);
    return f->edge_height - (sqrt(r2) - f->edge) * f->edge_slope;
}

static double brow_at(double y) {
    return exp(-(y - 21) * (y - 21) / (2 * 7.0 * 7.0));
}

static double cheek_at(double y) {
    return exp(-(y + 24) * (y + 24) / (2 * 8.0 * 8.0));
}

// All but the lids' bulge.
static double rest_height(const struct sim_relief *f, double x, double y) {
    double nose = x < -13 ? sim_step((-x - 13) / 18) * (1 - 0.3 * sim_step((y + 2) / 20)) : 0;
    double temple = x > 12 ? -8 * sim_step((x - 12) / 20) : 0;
    return 4 + f->brow * brow_at(y) + f->cheek * cheek_at(y) + f->nose * nose + temple;
}

double sim_relief_height(const struct sim_relief *relief, double x, double y) {
    double a = cap_height(relief, x * x + y * y), b = rest_height(relief, x, y);
    double h = 1 - fabs(a - b) / BLEND, m = a > b ? a : b;
    return h > 0 ? m + h * h * h * BLEND / 6 : m;
}

double sim_face_height(const struct sim_person *person, double x, double y) {
    struct sim_relief relief;
    sim_relief_init(&relief, person);
    return sim_relief_height(&relief, x, y);
}

static double step_slope(double t) {
    return t <= 0 || t >= 1 ? 0 : 30 * t * t * (1 - t) * (1 - t);
}

double sim_relief_slope(const struct sim_relief *f, double x, double y, double slope[2]) {
    double r = sqrt(x * x + y * y), a = cap_height(f, r * r);
    double fall = r < f->edge ? 1 / a : f->edge_slope / r;  // of the bulge, per unit of x or y
    double brow = f->brow * brow_at(y), cheek = f->cheek * cheek_at(y);
    double flank = sim_step((-x - 13) / 18), along = 1 - 0.3 * sim_step((y + 2) / 20);
    double b = 4 + brow + cheek + f->nose * flank * along - 8 * sim_step((x - 12) / 20);
    double bx = -f->nose * step_slope((-x - 13) / 18) / 18 * along - 8 * step_slope((x - 12) / 20) / 20;
    double by = -brow * (y - 21) / (7.0 * 7.0) - cheek * (y + 24) / (8.0 * 8.0) -
                f->nose * flank * 0.3 * step_slope((y + 2) / 20) / 20;
    double h = 1 - fabs(a - b) / BLEND, lower = h > 0 ? h * h / 2 : 0, of_a = a > b ? 1 - lower : lower;
    slope[0] = -of_a * fall * x + (1 - of_a) * bx;
    slope[1] = -of_a * fall * y + (1 - of_a) * by;
    return (a > b ? a : b) + (h > 0 ? h * h * h * BLEND / 6 : 0);
}

double sim_relief_on_lids(const struct sim_relief *relief, double rho) {
    return 1 - sim_step((rho - (relief->radius + 1)) / 1.5);
}

// No less than the highest point of a part over a rectangle.
static double highest(const struct sim_relief *f, enum sim_part part, double x0, double x1, double y0,
                      double y1) {
    double left = x0 < x1 ? x0 : x1, low = y0 < y1 ? y0 : y1, high = y0 < y1 ? y1 : y0;
    double right = x0 < x1 ? x1 : x0;
    double brow = f->brow > 0 ? f->brow * brow_at(high < 21 ? high : low > 21 ? low : 21) : 0;
    double cheek = f->cheek > 0 ? f->cheek * cheek_at(high < -24 ? high : low > -24 ? low : -24) : 0;
    double nose = f->nose > 0 && left < -13 ? f->nose * sim_step((-left - 13) / 18) : 0;
    double top = 4 + brow + cheek + nose;
    if (part == SIM_PART_RELIEF) return top;
    double x = left > 0 ? left : right < 0 ? right : 0, y = low > 0 ? low : high < 0 ? high : 0;
    double cap = cap_height(f, x * x + y * y), h = 1 - fabs(cap - top) / BLEND;
    return (cap > top ? cap : top) + (h > 0 ? h * h * h * BLEND / 6 : 0);
}

// A ray, and gap(u) / u on it.
struct ray {
    const struct sim_relief *relief;
    enum sim_part part;
    double x, y, height, dx, dy, rise;
};

struct sample {
    double u, g;
};

static struct sample sample_at(const struct ray *ray, double u) {
    double x = ray->x + u * ray->dx, y = ray->y + u * ray->dy;
    int all = ray->part == SIM_PART_ALL;
    double w = all ? sim_relief_height(ray->relief, x, y) : rest_height(ray->relief, x, y);
    struct sample s = {u, (ray->height - w) / u + ray->rise};
    return s;
}

// Vertex of the parabola through three samples; 0 when it has none between them.
static int vertex(struct sample a, struct sample b, struct sample c, struct sample *at) {
    double left = (b.g - a.g) / (b.u - a.u), right = (c.g - b.g) / (c.u - b.u);
    double bend = (right - left) / (c.u - a.u);
    double tilt = (left * (c.u - b.u) + right * (b.u - a.u)) / (c.u - a.u);
    if (!(bend > 0) || !isfinite(bend)) return 0;
    at->u = b.u - tilt / (2 * bend);
    at->g = b.g - tilt * tilt / (4 * bend);
    return at->u > a.u && at->u < c.u;
}

// The minimum between a and c, b being below both: successive parabolas, the golden section when they stall.
static double minimum(const struct ray *ray, struct sample a, struct sample b, struct sample c) {
    for (int i = 0; i < 40; ++i) {
        struct sample v;
        double width = c.u - a.u;
        int curved = i % 4 != 3 && vertex(a, b, c, &v);
        if (curved && b.g - v.g < 1e-9 && i > 0) return v.g < b.g ? v.g : b.g;
        if (width < 1e-9) break;
        double wider = b.u - a.u > c.u - b.u ? a.u - b.u : c.u - b.u;
        double u = curved ? v.u : b.u + 0.382 * wider;
        if (fabs(u - b.u) < 1e-3 * width) u = b.u + (c.u - b.u > b.u - a.u ? 1e-3 : -1e-3) * width;
        struct sample s = sample_at(ray, u);
        if (s.g < b.g) {
            if (s.u < b.u)
                c = b;
            else
                a = b;
            b = s;
        } else if (s.u < b.u) {
            a = s;
        } else {
            c = s;
        }
    }
    return b.g;
}

double sim_relief_horizon(const struct sim_relief *relief, enum sim_part part, const double from[3],
                          const double to[3], double at_zero, double lens) {
    if (at_zero <= -lens) return at_zero;
    struct ray ray = {relief, part, from[0], from[1], -from[2], to[0] - from[0], to[1] - from[1],
                      from[2] - to[2]};
    // From `end` on the ray is so high that all of the face lies below it by what the lens needs.
    double end = 1, spare = ray.rise - lens, best = at_zero;
    for (int i = 0; i < 4 && spare > 0; ++i) {
        double top = highest(relief, part, ray.x, ray.x + end * ray.dx, ray.y, ray.y + end * ray.dy);
        double u = (top - ray.height) / spare;
        if (u < TINY) return best < lens ? best : lens;
        if (u > 0.95 * end) break;
        end = u;
    }
    int n = (int)ceil(fmin(sqrt(ray.dx * ray.dx + ray.dy * ray.dy) * end / SAMPLE_MM, 2000));
    if (n < 2) n = 2;
    // Samples are evenly spaced; some more before the first, where a hollow's far edge may begin to hide at
    // once, and before the last.
    struct sample a, b = {0, at_zero}, c = {0, at_zero};
    for (int i = -3; i <= n + 1; ++i) {
        a = b;
        b = c;
        c = sample_at(&ray, end / n * (i < 1 ? ldexp(1, i - 1) : i < n ? i : i == n ? n - 0.1 : n));
        if (c.g <= -lens) return c.g;
        if (c.g < best) best = c.g;
        if (i == -3 || b.g > a.g || b.g > c.g) continue;
        struct sample v;
        if (vertex(a, b, c, &v) && v.g - (b.g - v.g) > (best < lens ? best : lens)) continue;
        double least = minimum(&ray, a, b, c);
        if (least < best) best = least;
    }
    return best;
}

double sim_relief_tangent(const double skin[3], const double slope[2], const double to[3]) {
    return skin[2] - to[2] - slope[0] * (to[0] - skin[0]) - slope[1] * (to[1] - skin[1]);
}

double sim_relief_share(const struct sim_relief *relief, const double skin[3], const double slope[2],
                        const double to[3], double lens) {
    double tangent = sim_relief_tangent(skin, slope, to);
    if (tangent <= -lens) return 1;
    double h = sim_relief_horizon(relief, SIM_PART_ALL, skin, to, tangent, lens);
    if (h >= lens || h == tangent) return 1;
    return sim_step(0.5 + h / (2 * lens)) / sim_step(0.5 + tangent / (2 * lens));
}

// Horizon of the eye's point in a direction, exact within +-reach; -INFINITY inside the relief.
static double eye_horizon(const struct sim_face *face, int site, double alpha, double beta, double reach) {
    double r = face->relief.radius, flat = r * cos(beta);
    double from[3] = {flat * sin(alpha), r * sin(beta), -flat * cos(alpha)};
    if (-from[2] <= rest_height(&face->relief, from[0], from[1])) return -INFINITY;
    return sim_relief_horizon(&face->relief, SIM_PART_RELIEF, from, face->sites[site], INFINITY, reach);
}

// What a cell's four corners say: 0 or 1 when nothing between them can be otherwise, judged by how much they
// differ.
static unsigned char judge(const double corner[4], double lens, double reach) {
    double low = INFINITY, high = -INFINITY;
    for (int i = 0; i < 4; ++i) {
        low = fmin(low, corner[i]);
        high = fmax(high, corner[i]);
    }
    if (low >= reach) return 1;
    if (high <= -reach) return 0;
    if (high > reach) high = reach;
    if (low < -reach) low = -reach;
    double spread = 0.25 + high - low;
    return low - spread >= lens ? 1 : high + spread <= -lens ? 0 : 2;
}

static int view_eye(struct sim_face *face, const struct sim_person *person) {
    const int across = SIM_VIEW_ALPHAS + 1, n = across * (SIM_VIEW_BETAS + 1);
    double *node = malloc((size_t)n * sizeof *node);
    if (!node) return -1;
    double half = person->canthus_deg * RADIANS;
    double up = (person->lid_upper_deg + 30 * person->lid_upper_follow) * RADIANS;
    double down = (person->lid_lower_deg - 30 * person->lid_lower_follow) * RADIANS;
    for (int s = 0; s < face->n_sites; ++s) {
        double lens = face->lens[s], reach = lens + 4;
        unsigned char *view = face->view + (size_t)s * SIM_VIEW_ALPHAS * SIM_VIEW_BETAS;
        for (int i = 0; i < n; ++i) {
            double alpha = VIEW_ALPHA * (2.0 * (i % across) / SIM_VIEW_ALPHAS - 1);
            double beta = VIEW_BETA * (2.0 * (i / across) / SIM_VIEW_BETAS - 1);
            node[i] = eye_horizon(face, s, alpha, beta, reach);
        }
        face->eye_clear[s] = 1;
        for (int j = 0; j < SIM_VIEW_BETAS; ++j)
            for (int i = 0; i < SIM_VIEW_ALPHAS; ++i) {
                const double *c = node + j * across + i, corner[4] = {c[0], c[1], c[across], c[across + 1]};
                double alpha = VIEW_ALPHA * ((2.0 * i + 1) / SIM_VIEW_ALPHAS - 1), a = alpha / half;
                double beta = VIEW_BETA * ((2.0 * j + 1) / SIM_VIEW_BETAS - 1);
                double line = person->canthus_tilt_deg / 45 * alpha, arch = a * a < 1 ? 1 - a * a : 0;
                int shown = beta < line + up * arch && beta > line + down * arch;
                view[j * SIM_VIEW_ALPHAS + i] = judge(corner, lens, reach);
                // What turns its back to the lens needs no view of it.
                double flat = cos(beta), toward = flat * sin(alpha) * face->sites[s][0] +
                                                  sin(beta) * face->sites[s][1] -
                                                  flat * cos(alpha) * face->sites[s][2];
                if (shown && toward > face->relief.radius - lens && view[j * SIM_VIEW_ALPHAS + i] != 1)
                    face->eye_clear[s] = 0;
            }
    }
    free(node);
    return 0;
}

int sim_face_open(struct sim_face *face, const struct sim_person *person, const double (*sites)[3],
                  const double *radius_mm, int n_sites) {
    memset(face, 0, sizeof *face);
    sim_relief_init(&face->relief, person);
    face->n_sites = n_sites;
    face->sites = calloc((size_t)n_sites, sizeof *face->sites);
    face->lens = calloc((size_t)n_sites, sizeof *face->lens);
    face->view = calloc((size_t)n_sites, SIM_VIEW_ALPHAS * SIM_VIEW_BETAS);
    face->eye_clear = calloc((size_t)n_sites, sizeof *face->eye_clear);
    if (!face->sites || !face->lens || !face->view || !face->eye_clear) return -1;
    memcpy(face->sites, sites, (size_t)n_sites * sizeof *sites);
    for (int s = 0; s < n_sites; ++s)
        face->lens[s] = radius_mm[s] > SIM_LEAST_LENS_MM ? radius_mm[s] : SIM_LEAST_LENS_MM;
    return view_eye(face, person);
}

void sim_face_close(struct sim_face *face) {
    free(face->sites);
    free(face->lens);
    free(face->view);
    free(face->eye_clear);
    memset(face, 0, sizeof *face);
}

double sim_face_eye_reach(const struct sim_face *face, int site, double alpha, double beta) {
    double i = (alpha / VIEW_ALPHA + 1) * (SIM_VIEW_ALPHAS / 2.0);
    double j = (beta / VIEW_BETA + 1) * (SIM_VIEW_BETAS / 2.0);
    if (i >= 0 && i < SIM_VIEW_ALPHAS && j >= 0 && j < SIM_VIEW_BETAS) {
        unsigned char seen = face->view[(site * SIM_VIEW_BETAS + (int)j) * SIM_VIEW_ALPHAS + (int)i];
        if (seen < 2) return seen;
    }
    double lens = face->lens[site];
    return sim_step(0.5 + eye_horizon(face, site, alpha, beta, lens) / (2 * lens));
}
