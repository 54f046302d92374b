// SPDX-License-Identifier: Apache-2.0
//
// The four terms of a response by adaptive cubature (reference_cubature.c) of the model as written
// (reference_world.c): the simulator's judge, slow and independent of it.
//
// face    over (x, y) of the frontal plane
// sclera  over polar angle and azimuth of the eye's own frame, from the limbus to its back
// iris    from one end: rays through the cornea by Snell's law, over the part of the cornea through which that end
//         sees the iris between pupil and rim (found on every ray from the image of the pupil's centre); the
//         other end's ray to the same spot by shooting
// glint   over polar angle and azimuth, after a search that drops what provably has no lobe
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846
#define DEGREE (PI / 180)

#include "reference_declared.h"

#include "reference_cubature.c"
#include "reference_world.c"

enum { MAX_PORTS = 64, MAX_PAIRS = 1024, MAX_CELLS = 60000 };
static const double THETA_END = 105 * DEGREE;

struct scene {
    const struct world *worlds;  // one per state; eye and lids differ
    int n_worlds, n_ports, n_pairs;
    struct ref_port ports[MAX_PORTS];  // sensors, then emitters
    int first[MAX_PORTS];              // the first port at the same place with the same lens
    int pair[MAX_PAIRS][2];            // port numbers
};

// Every port's factor at a surface element (head frame), lids left out: window * cosine / distance^2.
static int ports_at(const struct scene *scene, const double *point, const double *normal, double *factor,
                    double (*away)[3]) {
    int any = 0;
    for (int k = 0; k < scene->n_ports; ++k) {
        const struct ref_port *port = &scene->ports[k];
        double d = toward(point, port->position, away[k]);
        factor[k] = rounded_cosine(dot(away[k], normal), port->radius_mm / d + 1e-9) / (d * d);
        if (factor[k] > 0) factor[k] *= window(port, away[k]);
        any |= factor[k] > 0;
    }
    return any;
}

static void wanted_ports(const struct scene *scene, const double *factor, double least, int *wanted) {
    memset(wanted, 0, MAX_PORTS * sizeof *wanted);
    for (int i = 0; i < scene->n_pairs; ++i) {
        const int *p = scene->pair[i];
        if (factor[p[0]] * factor[p[1]] > least) wanted[p[0]] = wanted[p[1]] = 1;
    }
}

struct surface {
    const struct scene *scene;
    const struct world *world;
    double brightest;  // product of two factors seen so far: what is 1e-10 of it is left out
};

static void add_face(void *context, double x, double y, double *out) {
    struct surface *surface = context;
    const struct scene *scene = surface->scene;
    const struct world *w = &scene->worlds[0];
    double point[3] = {x, y, -face(w, x, y)}, slope_x = face_slope(w, x, y, 0), slope_y = face_slope(w, x, y, 1);
    double size = sqrt(1 + slope_x * slope_x + slope_y * slope_y), rho = sqrt(dot(point, point));
    double normal[3] = {-slope_x / size, -slope_y / size, -1 / size};
    double factor[MAX_PORTS], away[MAX_PORTS][3], share[MAX_PORTS], skin[16];
    int wanted[MAX_PORTS];
    if (!ports_at(scene, point, normal, factor, away)) return;
    for (int i = 0; i < scene->n_pairs; ++i) {
        double product = factor[scene->pair[i][0]] * factor[scene->pair[i][1]];
        if (product > surface->brightest) surface->brightest = product;
    }
    wanted_ports(scene, factor, 1e-10 * surface->brightest, wanted);
    int lid = fabs(atan2(x, -point[2])) < (w->p.canthus_deg + 4) * DEGREE &&
              fabs(asin(y / rho)) < 65 * DEGREE && point[2] < -1;
    for (int s = 0; s < scene->n_worlds; ++s) {
        struct lid_place at;
        skin[s] = 1;
        if (!lid) continue;
        lid_measure(&scene->worlds[s], point, &at);
        skin[s] -= step5(at.above / w->p.lid_softness_mm) * step5(at.below / w->p.lid_softness_mm);
    }
    for (int k = 0; k < scene->n_ports; ++k) share[k] = -1;
    for (int k = 0; k < scene->n_ports; ++k) {
        if (!wanted[k]) {
            factor[k] = 0;
            continue;
        }
        int same = scene->first[k];
        if (share[same] < 0) {
            const double *q = scene->ports[k].position;
            double lens = scene->ports[k].radius_mm > 0.25 ? scene->ports[k].radius_mm : 0.25;
            double d[3] = {q[0] - point[0], q[1] - point[1], q[2] - point[2]}, tangent = dot(d, normal) * size;
            if (tangent <= -lens) share[same] = 1;
            else
                share[same] = step5(0.5 + horizon(w, 0, point, q, tangent, lens) / (2 * lens)) /
                              step5(0.5 + tangent / (2 * lens));
        }
        factor[k] *= share[same];
    }
    for (int i = 0; i < scene->n_pairs; ++i) {
        double product = factor[scene->pair[i][0]] * factor[scene->pair[i][1]] * size * w->p.albedo_skin / PI;
        for (int s = 0; s < scene->n_worlds; ++s) out[s * scene->n_pairs + i] = product * skin[s];
    }
}

// Part of a lens at a place of the sclera's that the corneal bulge, a sphere, leaves open.
static double past_bulge(const struct world *w, const double *point, const double *away, double distance,
                         double lens) {
    double c[3], level = w->apex - w->p.cornea_radius_mm;
    for (int k = 0; k < 3; ++k) c[k] = level * w->axis_z[k] - point[k];
    double along = dot(c, away), beside[3];
    if (along <= 0) return 1;
    for (int k = 0; k < 3; ++k) beside[k] = c[k] - along * away[k];
    double miss = sqrt(dot(beside, beside)) - w->p.cornea_radius_mm;
    return step5(0.5 + miss * distance / (2 * (lens + 0.3) * along));
}

// Point, unit outward normal (head frame) and area per d theta d phi of the eye's surface.
static double eye_surface(const struct world *w, double theta, double phi, double *radius, double *point,
                          double *normal) {
    double slope, rho = profile(w, theta, &slope), s = sin(theta), c = cos(theta), size = hypot(rho, slope);
    double out = (rho * s - slope * c) / size, up = (rho * c + slope * s) / size;
    double eye[3] = {rho * s * cos(phi), rho * s * sin(phi), rho * c}, n[3] = {out * cos(phi), out * sin(phi), up};
    *radius = rho * s;
    to_head(w, eye, point);
    to_head(w, n, normal);
    return rho * s * size;
}

static void add_sclera(void *context, double theta, double phi, double *out) {
    struct surface *surface = context;
    const struct scene *scene = surface->scene;
    const struct world *w = surface->world;
    double radius, point[3], normal[3], factor[MAX_PORTS], away[MAX_PORTS][3], face_share[MAX_PORTS];
    double weight = eye_surface(w, theta, phi, &radius, point, normal) * w->p.albedo_sclera / PI;
    if (cos(theta) > 0) weight *= white(w, radius);
    struct lid_place at;
    lid_measure(w, point, &at);
    if (weight <= 0 || at.above <= 0 || at.below <= 0 || !ports_at(scene, point, normal, factor, away)) return;
    for (int k = 0; k < scene->n_ports; ++k) {
        if (factor[k] > 0) factor[k] *= lids_pass(w, &at, away[k]);
        if (factor[k] <= 0) continue;
        double beyond[3];
        double d = toward(point, scene->ports[k].position, beyond);
        factor[k] *= past_bulge(w, point, beyond, d, scene->ports[k].radius_mm);
    }
    int wanted[MAX_PORTS];
    for (int i = 0; i < scene->n_pairs; ++i) {
        double product = factor[scene->pair[i][0]] * factor[scene->pair[i][1]];
        if (product > surface->brightest) surface->brightest = product;
    }
    wanted_ports(scene, factor, 1e-10 * surface->brightest, wanted);
    for (int k = 0; k < scene->n_ports; ++k) face_share[k] = -1;
    for (int k = 0; k < scene->n_ports; ++k) {
        int same = scene->first[k];
        if (wanted[k] && face_share[same] < 0)
            face_share[same] = face_passes(w, point, scene->ports[k].position, scene->ports[k].radius_mm);
        factor[k] = wanted[k] ? factor[k] * face_share[same] : 0;
    }
    for (int i = 0; i < scene->n_pairs; ++i)
        out[i] = weight * factor[scene->pair[i][0]] * factor[scene->pair[i][1]];
}

// ---- Iris, seen from one port.
//
// Where a port is so low that rays through the cornea fold on the iris, a spot has two paths; the model's is the
// shorter one (positive Jacobian). Tracing starts from such an end: the caustic is then no singularity.
enum { SLOTS = 4, STARTS = 40 };

struct seen {  // how one port sees the iris
    double place[3];  // eye frame
    int folds, has_last, n_starts;
    struct ray last;
    double (*starts)[4];  // spot and crossing of rays to start from, where it folds
};

struct iris {
    const struct scene *scene;
    const struct world *w;
    struct seen *seen;  // [ports] of this state
    int from, n_others, other[MAX_PORTS], all_paths, n_slots;
    double pupil, reach;  // radii: of the pupil, of the clear part of the cornea
    double centre[2];     // of the pupil's image on the cornea, where nothing folds
    double row, slot[SLOTS][2];
};

static double determinant(const struct ray *ray) {
    return ray->jacobian[0] * ray->jacobian[3] - ray->jacobian[1] * ray->jacobian[2];
}

// Share of one end of a ray: window, Fresnel, veil, lids, face.
static double end_share(const struct iris *iris, int port, const struct ray *ray) {
    const struct world *w = iris->w;
    const struct ref_port *p = &iris->scene->ports[port];
    double share = 1 - white(w, hypot(ray->point[0], ray->point[1])), head[3], away[3];
    if (ray->cosine <= 0 || share <= 0) return 0;
    struct lid_place at;
    to_head(w, ray->point, head);
    toward(head, p->position, away);
    lid_measure(w, head, &at);
    share *= lids_pass(w, &at, away);
    if (share > 0) share *= (1 - fresnel(w->p.refractive_index, ray->cosine)) * window(p, away);
    if (share > 1e-14) share *= face_passes(w, head, p->position, p->radius_mm);
    return share;
}

// Whether the rays of a port fold on the iris; if so, the unfolded ones to start from.
static int prepare_seen(struct seen *seen, const struct world *w) {
    double reach = w->p.limbus_radius_mm + w->p.limbus_haze_mm / 2, rim = 1.02 * w->p.limbus_radius_mm;
    if (!(seen->starts = malloc(STARTS * STARTS * sizeof *seen->starts))) return -1;
    for (int k = 0; k < STARTS * STARTS; ++k) {
        double x = (2 * (k % STARTS + 0.5) / STARTS - 1) * reach, y = (2 * (k / STARTS + 0.5) / STARTS - 1) * reach;
        struct ray ray;
        if (hypot(x, y) > reach || !refract_ray(w, seen->place, x, y, &ray) || ray.cosine < -0.02) continue;
        if (hypot(ray.spot[0], ray.spot[1]) < rim && determinant(&ray) < 0.03) seen->folds = 1;
        if (ray.cosine <= 0 || determinant(&ray) <= 0) continue;
        double start[4] = {ray.spot[0], ray.spot[1], x, y};
        memcpy(seen->starts[seen->n_starts++], start, sizeof start);
    }
    return 0;
}

static int is_shortest(const struct ray *ray) { return ray->cosine > 0 && determinant(ray) > 0; }

// The shortest path between a port and a spot.
static int find_path(const struct world *w, struct seen *seen, const double *spot, struct ray *ray) {
    struct ray *last = &seen->last;
    int found = 0;
    if (seen->has_last) {
        const double *j = last->jacobian;
        double det = determinant(last), ex = spot[0] - last->spot[0], ey = spot[1] - last->spot[1];
        double dx = (j[3] * ex - j[1] * ey) / det, dy = (j[0] * ey - j[2] * ex) / det;
        if (hypot(dx, dy) < 1) found = shoot(w, seen->place, spot, last->point[0] + dx, last->point[1] + dy, ray);
        if (found && seen->folds && !is_shortest(ray)) found = 0;
    }
    if (!found && !seen->folds) found = shoot(w, seen->place, spot, spot[0], spot[1], ray);
    double after = -1;
    for (int k = 0; k < 6 && !found; ++k) {  // from the nearest spots whose path is known
        double nearest = 1e300;
        int best = -1;
        for (int i = 0; i < seen->n_starts; ++i) {
            double d = hypot(seen->starts[i][0] - spot[0], seen->starts[i][1] - spot[1]);
            if (d > after && d < nearest) nearest = d, best = i;
        }
        if (best < 0) break;
        after = nearest;
        found = shoot(w, seen->place, spot, seen->starts[best][2], seen->starts[best][3], ray);
        if (found && seen->folds && !is_shortest(ray)) found = 0;
    }
    seen->has_last = found && is_shortest(ray);
    if (seen->has_last) *last = *ray;
    return found && is_shortest(ray);
}

// Where a ray of the cornea, from the pupil's image outward, meets the image of a circle of the iris.
static double circle_at(const struct iris *iris, double phi, double radius, double guess, double end) {
    const double *from = iris->seen[iris->from].place;
    double c = cos(phi), s = sin(phi), low = 0, high = end, t = guess < end ? guess : end / 2;
    for (int i = 0; i < 80; ++i) {
        struct ray ray;
        double f = 1, slope = 0;
        if (refract_ray(iris->w, from, iris->centre[0] + t * c, iris->centre[1] + t * s, &ray)) {
            double r = hypot(ray.spot[0], ray.spot[1]);
            const double *j = ray.jacobian;
            f = r - radius;
            slope = (ray.spot[0] * (j[0] * c + j[1] * s) + ray.spot[1] * (j[2] * c + j[3] * s)) / (r + 1e-300);
        }
        if (f > 0) high = t;
        else low = t;
        if (fabs(f) < 1e-12 || high - low < 1e-13) break;
        double next = slope > 0 ? t - f / slope : 0;
        t = next > low && next < high ? next : (low + high) / 2;
    }
    return t;
}

// Nothing folds: rows are rays of the cornea from the pupil's image, and each has one stretch of iris.
static void polar_row(struct iris *iris, double phi) {
    // The clear cornea's circle on this ray: |centre + t e| = reach.
    double c = cos(phi), s = sin(phi), b = iris->centre[0] * c + iris->centre[1] * s;
    double miss2 = iris->centre[0] * iris->centre[0] + iris->centre[1] * iris->centre[1] - b * b;
    double half2 = iris->reach * iris->reach - miss2, half = half2 > 0 ? sqrt(half2) : 0;
    double leave = -b + half, enter = fmax(0, -b - half);
    iris->n_slots = 0;
    if (half2 <= 0 || leave <= enter) return;
    iris->slot[0][0] = fmax(circle_at(iris, phi, iris->pupil, iris->pupil, leave), enter);
    iris->slot[0][1] = circle_at(iris, phi, iris->w->p.limbus_radius_mm, leave, leave);
    iris->n_slots = iris->slot[0][1] > iris->slot[0][0];
}

// Whether the ray through (x, y) counts and meets the iris.
static int kind_at(const struct iris *iris, double x, double y) {
    struct ray ray;
    if (!refract_ray(iris->w, iris->seen[iris->from].place, x, y, &ray) || ray.cosine <= 0) return 0;
    double r = hypot(ray.spot[0], ray.spot[1]);
    if (!iris->all_paths && determinant(&ray) <= 0) return 0;
    return r > iris->pupil && r < iris->w->p.limbus_radius_mm;
}

// Something folds: rows are parallel lines, with up to SLOTS stretches of iris each, found by stepping.
static void line_row(struct iris *iris, double y) {
    enum { STEPS = 160 };
    double half = sqrt(iris->reach * iris->reach - y * y), last = -half;
    const double *place = iris->seen[iris->from].place;
    double along[2] = {place[0] / hypot(place[0], place[1]), place[1] / hypot(place[0], place[1])};
    int was = 0;
    iris->n_slots = 0;
    for (int i = 0; i <= STEPS; ++i) {
        double x = -half * cos(PI * i / STEPS);
        int is = i < STEPS && kind_at(iris, x * along[0] - y * along[1], x * along[1] + y * along[0]);
        if (is != was) {
            double low = last, high = x;
            for (int k = 0; k < 48; ++k) {
                double mid = (low + high) / 2;
                int here = kind_at(iris, mid * along[0] - y * along[1], mid * along[1] + y * along[0]);
                if (here == was) low = mid;
                else high = mid;
            }
            if (is && iris->n_slots == SLOTS) return;
            if (is) iris->slot[iris->n_slots][0] = iris->slot[iris->n_slots][1] = high;
            else iris->slot[iris->n_slots++][1] = low;
        }
        was = is;
        last = x;
    }
}

static void add_iris(void *context, double t, double row, double *out) {
    struct iris *iris = context;
    const struct world *w = iris->w;
    struct seen *from = &iris->seen[iris->from];
    struct ray ray, back;
    if (row != iris->row) {
        if (from->folds) line_row(iris, row);
        else polar_row(iris, row);
        iris->row = row;
    }
    int slot = (int)t;
    if (slot >= iris->n_slots) return;
    double length = iris->slot[slot][1] - iris->slot[slot][0], r = iris->slot[slot][0] + (t - slot) * length;
    double x = iris->centre[0] + r * cos(row), y = iris->centre[1] + r * sin(row), weight = length * r;
    if (from->folds) {
        double far = hypot(from->place[0], from->place[1]), c = from->place[0] / far, s = from->place[1] / far;
        x = r * c - row * s, y = r * s + row * c, weight = length;
    }
    if (!refract_ray(w, from->place, x, y, &ray)) return;
    double n = w->p.refractive_index;
    weight *= w->p.albedo_iris / (PI * n * n) * ray.solid * end_share(iris, iris->from, &ray);
    if (weight <= 0) return;
    for (int i = 0; i < iris->n_others; ++i) {
        struct seen *to = &iris->seen[iris->other[i]];
        if (find_path(w, to, ray.spot, &back))
            out[i] = weight * end_share(iris, iris->other[i], &back) * back.solid / determinant(&back);
    }
}

static void start_iris(struct iris *iris, struct cubature *c) {
    const double centre[2] = {0, 0};
    struct seen *from = &iris->seen[iris->from];
    iris->row = 1e9;
    if (from->folds) {
        cubature_grid(c, 0, SLOTS, SLOTS, -iris->reach, iris->reach, 6);
        return;
    }
    struct ray ray;
    int found = shoot(iris->w, from->place, centre, 0, 0, &ray);
    for (int k = 0; k < from->n_starts && !found; ++k)
        found = shoot(iris->w, from->place, centre, from->starts[k][2], from->starts[k][3], &ray);
    if (!found) return;
    iris->centre[0] = ray.point[0];
    iris->centre[1] = ray.point[1];
    cubature_grid(c, 0, 1, 1, 0, 2 * PI, 4);
}

// ---- Glint of one pair.
struct glint {
    const struct world *w;
    const struct ref_port *port[2];
    double alpha2;
};

static void add_glint(void *context, double theta, double phi, double *out) {
    const struct glint *g = context;
    const struct world *w = g->w;
    double radius, point[3], normal[3], away[2][3], d[2], h[3], product[3];
    double weight = eye_surface(w, theta, phi, &radius, point, normal);
    for (int k = 0; k < 2; ++k) {
        d[k] = toward(point, g->port[k]->position, away[k]);
        if (dot(away[k], normal) <= 0) return;
    }
    for (int k = 0; k < 3; ++k) h[k] = away[0][k] + away[1][k];
    double size = sqrt(dot(h, h));
    for (int k = 0; k < 3; ++k) h[k] /= size;
    cross(normal, h, product);
    double c = dot(normal, h), slope2 = dot(product, product) / (c * c * g->alpha2);
    if (slope2 > 45) return;
    struct lid_place at;
    lid_measure(w, point, &at);
    weight *= exp(-slope2) / (PI * g->alpha2 * c * c * c * c) / (4 * d[0] * d[0] * d[1] * d[1]);
    weight *= fresnel(w->p.refractive_index, dot(away[0], h));
    for (int k = 0; k < 2; ++k) weight *= lids_pass(w, &at, away[k]) * window(g->port[k], away[k]);
    for (int k = 0; k < 2 && weight > 0; ++k)
        weight *= face_passes(w, point, g->port[k]->position, g->port[k]->radius_mm);
    *out = weight;
}

// Greatest rate at which the normal turns along the profile, per radian of theta, over an interval.
static double tilt_rate(const struct world *w, double from, double to) {
    double most = 0, last = 0, step = (to - from) / 16;
    if (step > 2e-3) step = 2e-3;
    if (step < 1e-5) step = 1e-5;
    int n = (int)ceil((to - from) / step) + 2;
    for (int i = 0; i <= n; ++i) {
        double theta = from + (i - 1) * step, slope, rho = profile(w, theta, &slope), tilt = theta - atan2(slope, rho);
        if (i && fabs(tilt - last) > most * step) most = fabs(tilt - last) / step;
        last = tilt;
    }
    return 1.2 * most + 0.05;
}

// Hand to the cubature every part of the rectangle on which the lobe may be, small against the lobe.
static void search_lobe(struct cubature *c, const struct glint *g, double x0, double x1, double y0, double y1) {
    double theta = (x0 + x1) / 2, phi = (y0 + y1) / 2, half_x = (x1 - x0) / 2, half_y = (y1 - y0) / 2;
    double radius, point[3], normal[3], away[2][3], slope, rho = profile(g->w, theta, &slope), h[3], turn_h = 0;
    eye_surface(g->w, theta, phi, &radius, point, normal);
    double rate = tilt_rate(g->w, x0, x1), far = fmax(g->w->apex, g->w->p.globe_radius_mm);
    double move_x = 1.1 * hypot(rho, slope) * half_x + 8 * rate * half_x * half_x, move_y;
    move_y = fmin(far, radius + move_x) * half_y;
    double move = move_x + move_y, tilt_x = rate * half_x, tilt = theta - atan2(slope, rho);
    double tilt_y = fmin(1, fabs(sin(tilt)) + tilt_x) * half_y, turn = tilt_x + tilt_y;
    double cutoff = atan(sqrt(45 * g->alpha2));
    int dark = 0, near = 0;
    for (int k = 0; k < 2; ++k) {
        double d = toward(point, g->port[k]->position, away[k]), left = d - move;
        near |= left <= 0;
        double part = left > 0 ? move / left : 10;
        turn_h += part;
        dark |= acos(fmax(-1, fmin(1, dot(away[k], normal)))) - turn - part > PI / 2;
    }
    for (int k = 0; k < 3; ++k) h[k] = away[0][k] + away[1][k];
    double size = sqrt(dot(h, h)), cosine = size > 0 ? dot(h, normal) / size : 1;
    double angle = acos(fmax(-1, fmin(1, cosine))), least = size - turn_h;
    double spread = turn + (least > 0 ? turn_h / least : 10);
    if (!near && (dark || angle - spread > cutoff)) return;
    int small = spread < 5 * sqrt(g->alpha2) && !near;
    if (g->alpha2 > 0.004) small = half_x < 0.12 && half_y < 0.3 && !near;
    if (small || half_x < 1e-7) {
        cubature_add(c, x0, x1, y0, y1);
    } else if (tilt_x + move_x / 8 >= tilt_y + move_y / 8) {
        search_lobe(c, g, x0, theta, y0, y1);
        search_lobe(c, g, theta, x1, y0, y1);
    } else {
        search_lobe(c, g, x0, x1, y0, phi);
        search_lobe(c, g, x0, x1, phi, y1);
    }
}

static double lobe_alpha2(const struct world *w, const struct ref_port *a, const struct ref_port *b) {
    double alpha2 = w->p.roughness * w->p.roughness, big = w->p.cornea_radius_mm;
    for (int k = 0; k < 2; ++k) {
        const struct ref_port *p = k ? b : a;
        double d[3];
        for (int i = 0; i < 3; ++i) d[i] = p->position[i] - (w->apex - big) * w->axis_z[i];
        double half = p->radius_mm / (2 * (sqrt(dot(d, d)) - 0.9 * big));
        alpha2 += half * half / 2;
    }
    return alpha2;
}

// ---- All of it.
struct job {
    struct cubature cubature;
    int state, term, n, *slot;  // slot: index of each component in the result
    double *value, *error;
    union {
        struct surface surface;
        struct iris iris;
        struct glint glint;
    } context;
};

static struct job *new_job(struct job ***jobs, int *n_jobs, int state, int term, int n, integrand f) {
    struct job **more = realloc(*jobs, (size_t)(*n_jobs + 1) * sizeof **jobs), *job;
    if (!more) return NULL;
    *jobs = more;
    if (!(job = calloc(1, sizeof *job))) return NULL;
    more[(*n_jobs)++] = job;
    job->state = state, job->term = term, job->n = n;
    job->slot = calloc((size_t)n, sizeof(int));
    job->value = calloc((size_t)n, sizeof(double));
    job->error = calloc((size_t)n, sizeof(double));
    cubature_open(&job->cubature, n, f, &job->context);
    return job->slot && job->value && job->error ? job : NULL;
}

// The end to trace from: the sensor's, unless only the emitter's rays fold.
static int iris_from(const int *pair, const struct seen *seen) {
    return pair[seen[pair[1]].folds && !seen[pair[0]].folds];
}

static int open_jobs(const struct scene *scene, const double *states, int terms, struct seen *all_seen,
                     struct job ***jobs, int *n_jobs) {
    int np = scene->n_pairs;
    struct job *job;
    if (terms & 1) {
        if (!(job = new_job(jobs, n_jobs, 0, 0, np * scene->n_worlds, add_face))) return -1;
        for (int i = 0; i < job->n; ++i) job->slot[i] = i / np * 4 * np + i % np;
        job->context.surface = (struct surface){.scene = scene};
        cubature_grid(&job->cubature, -34, 30, 6, -32, 32, 6);
    }
    for (int s = 0; s < scene->n_worlds; ++s) {
        const struct world *w = &scene->worlds[s];
        int base = s * 4 * np;
        if (terms & 2) {
            if (!(job = new_job(jobs, n_jobs, s, 1, np, add_sclera))) return -1;
            for (int i = 0; i < np; ++i) job->slot[i] = base + np + i;
            job->context.surface = (struct surface){.scene = scene, .world = w};
            double from = 0, to = PI / 2, edge = w->p.limbus_radius_mm - w->p.limbus_haze_mm / 2, slope;
            for (int i = 0; i < 60; ++i) {
                double mid = (from + to) / 2;
                if (profile(w, mid, &slope) * sin(mid) > edge) to = mid;
                else from = mid;
            }
            cubature_grid(&job->cubature, from, 1.2, 4, 0, 2 * PI, 8);
            cubature_grid(&job->cubature, 1.2, PI, 3, 0, 2 * PI, 8);
        }
        struct seen *seen = terms & 4 ? &all_seen[s * scene->n_ports] : NULL;
        for (int k = 0; k < scene->n_ports && seen; ++k) {
            to_eye(w, scene->ports[k].position, seen[k].place);
            if (prepare_seen(&seen[k], w)) return -1;
        }
        for (int k = 0; k < scene->n_ports && seen; ++k) {
            int n = 0;
            for (int i = 0; i < np; ++i) n += iris_from(scene->pair[i], seen) == k;
            if (!n) continue;
            if (!(job = new_job(jobs, n_jobs, s, 2, n, add_iris))) return -1;
            struct iris *iris = &job->context.iris;
            *iris = (struct iris){.scene = scene, .w = w, .seen = seen, .from = k, .all_paths = (terms & 16) != 0};
            iris->pupil = states[4 * s + 2] / 2;
            iris->reach = w->p.limbus_radius_mm + w->p.limbus_haze_mm / 2;
            for (int i = 0; i < np; ++i) {
                if (iris_from(scene->pair[i], seen) != k) continue;
                job->slot[iris->n_others] = base + 2 * np + i;
                iris->other[iris->n_others++] = scene->pair[i][scene->pair[i][0] == k];
            }
            start_iris(iris, &job->cubature);
        }
        for (int i = 0; i < np && terms & 8; ++i) {
            if (!(job = new_job(jobs, n_jobs, s, 3, 1, add_glint))) return -1;
            job->slot[0] = base + 3 * np + i;
            const struct ref_port *a = &scene->ports[scene->pair[i][0]], *b = &scene->ports[scene->pair[i][1]];
            job->context.glint = (struct glint){.w = w, .port = {a, b}, .alpha2 = lobe_alpha2(w, a, b)};
            search_lobe(&job->cubature, &job->context.glint, 0, THETA_END, 0, 2 * PI);
        }
    }
    return 0;
}

int ref_evaluate(const struct ref_person *person, const struct ref_port *sensors, int n_sensors,
                 const struct ref_port *emitters, int n_emitters, const int *pairs, const int *counts, int n_pairs,
                 const double *states, int n_states, int terms, double tol, double scale, double *value, double *error,
                 long *points) {
    if (n_sensors + n_emitters > MAX_PORTS || n_pairs > MAX_PAIRS || n_states > 16) return -1;
    struct world worlds[16];
    struct scene *scene = calloc(1, sizeof *scene);
    struct seen *seen = calloc((size_t)(n_states * (n_sensors + n_emitters)), sizeof *seen);
    struct job **jobs = NULL;
    int n_jobs = 0, bad = !scene || !seen;
    for (int s = 0; s < n_states; ++s) {
        worlds[s].p = *person;
        world_eye(&worlds[s], states[4 * s], states[4 * s + 1]);
        world_lids(&worlds[s], states[4 * s + 1], states[4 * s + 3]);
    }
    if (!bad) {
        scene->worlds = worlds, scene->n_worlds = n_states, scene->n_pairs = n_pairs;
        scene->n_ports = n_sensors + n_emitters;
        memcpy(scene->ports, sensors, (size_t)n_sensors * sizeof *sensors);
        memcpy(scene->ports + n_sensors, emitters, (size_t)n_emitters * sizeof *emitters);
        for (int k = 0; k < scene->n_ports; ++k) {
            int f = 0;
            while (memcmp(scene->ports[f].position, scene->ports[k].position, sizeof scene->ports[k].position) ||
                   scene->ports[f].radius_mm != scene->ports[k].radius_mm)
                ++f;
            scene->first[k] = f;
        }
        for (int i = 0; i < n_pairs; ++i)
            scene->pair[i][0] = pairs[2 * i], scene->pair[i][1] = n_sensors + pairs[2 * i + 1];
        bad = open_jobs(scene, states, terms, seen, &jobs, &n_jobs);
    }
    memset(value, 0, (size_t)(4 * n_states * n_pairs) * sizeof *value);
    memset(error, 0, (size_t)(4 * n_states * n_pairs) * sizeof *error);
    memset(points, 0, 4 * sizeof *points);
    for (int round = 0; round < 2 && !bad; ++round) {
        // First each term to a fiftieth of itself; what that says of the whole sets the goal of all.
        double goal[16], least = 1e300;
        for (int s = 0; s < n_states && round; ++s) {
            double sum = 0, n = 0;
            for (int t = 0; t < 4; ++t)
                for (int i = 0; i < n_pairs; ++i) sum += counts[i] ? value[(4 * s + t) * n_pairs + i] : 0;
            for (int i = 0; i < n_pairs; ++i) n += counts[i];
            goal[s] = tol * (scale > 0 ? scale : sum / n);
            if (goal[s] < least) least = goal[s];
        }
        for (int k = 0; k < n_jobs; ++k) {
            struct job *job = jobs[k];
            double own = 0;
            cubature_sum(&job->cubature, job->value, job->error);
            for (int i = 0; i < job->n; ++i) own = fmax(own, job->value[i] / 50);
            cubature_run(&job->cubature, round ? (job->term ? goal[job->state] : least) : own,
                         round ? MAX_CELLS : 2000, job->value, job->error);
            for (int i = 0; i < job->n; ++i) value[job->slot[i]] = job->value[i], error[job->slot[i]] = job->error[i];
            points[job->term] += round ? job->cubature.points : 0;
            bad |= job->cubature.failed;
        }
    }
    for (int k = 0; k < n_jobs; ++k) {
        cubature_close(&jobs[k]->cubature);
        free(jobs[k]->slot), free(jobs[k]->value), free(jobs[k]->error);
        free(jobs[k]);
    }
    for (int k = 0; seen && k < n_states * (n_sensors + n_emitters); ++k) free(seen[k].starts);
    free(seen);
    free(jobs);
    free(scene);
    return bad ? -1 : 0;
}

double ref_face_mm(const struct ref_person *person, double x, double y) {
    struct world w = {.p = *person};
    return face(&w, x, y);
}

double ref_iris_light(const struct ref_person *person, const double *site, const double *spot, double *exit) {
    struct world w = {.p = *person};
    struct seen seen = {.place = {site[0], site[1], site[2]}};
    struct ray ray;
    world_eye(&w, 0, 0);
    if (prepare_seen(&seen, &w)) return -1;
    int found = find_path(&w, &seen, spot, &ray);
    free(seen.starts);
    if (!found) return 0;
    memcpy(exit, ray.point, sizeof ray.point);
    return ray.solid / determinant(&ray) * (1 - fresnel(person->refractive_index, ray.cosine));
}
