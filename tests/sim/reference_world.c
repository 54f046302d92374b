// SPDX-License-Identifier: Apache-2.0
//
// What the reference knows of the world, written anew from the model's words: the eye's surface, its turning,
// the lids, the face, its soft horizon, Snell's law. Shares no line with sim_c. Included by reference.c.
static double step5(double t) {
    return t <= 0 ? 0 : t >= 1 ? 1 : t * t * t * (10 - 15 * t + 6 * t * t);
}

static double dot(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static double toward(const double *from, const double *to, double *unit) {
    for (int k = 0; k < 3; ++k) unit[k] = to[k] - from[k];
    double length = sqrt(dot(unit, unit));
    for (int k = 0; k < 3; ++k) unit[k] /= length;
    return length;
}

struct world {
    struct ref_person p;
    double apex, iris_z, conic;              // conic = 1 + Q
    double axis_x[3], axis_y[3], axis_z[3];  // of the eye, head frame
    double lid_up, lid_low, lid_half;        // margins at alpha = 0, half width, radians
};

static void fick(double azimuth_deg, double elevation_deg, double *d) {
    double a = azimuth_deg * DEGREE, e = elevation_deg * DEGREE;
    d[0] = cos(e) * sin(a);
    d[1] = sin(e);
    d[2] = -cos(e) * cos(a);
}

static void cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double sag(const struct world *w, double r2) {
    double big = w->p.cornea_radius_mm;
    return r2 / (big + sqrt(big * big - w->conic * r2));
}

// The eye of a person at a gaze: turned by Listing's law, the mirror image of the optical axis in the plane
// across the bisector of rest and gaze, mirrored again in the plane across rest.
static void world_eye(struct world *w, double azimuth_deg, double elevation_deg) {
    double limbus2 = w->p.limbus_radius_mm * w->p.limbus_radius_mm, gaze[3], optical[3], middle[3];
    w->conic = 1 + w->p.cornea_asphericity;
    w->apex = sqrt(w->p.globe_radius_mm * w->p.globe_radius_mm - limbus2) + sag(w, limbus2);
    w->iris_z = w->apex - w->p.iris_depth_mm;
    fick(azimuth_deg, elevation_deg, gaze);
    fick(w->p.kappa_azimuth_deg, w->p.kappa_elevation_deg, optical);
    double rest[3] = {0, 0, -1};
    for (int k = 0; k < 3; ++k) middle[k] = rest[k] + gaze[k];
    double n = sqrt(dot(middle, middle)), along;
    for (int k = 0; k < 3; ++k) middle[k] /= n;
    along = 2 * dot(optical, rest);  // two half turns, about rest and about the bisector, are the rotation
    for (int k = 0; k < 3; ++k) w->axis_z[k] = along * rest[k] - optical[k];
    along = 2 * dot(w->axis_z, middle);
    for (int k = 0; k < 3; ++k) w->axis_z[k] = along * middle[k] - w->axis_z[k];
    double any[3] = {0.31, 0.9, 0.17};
    cross(any, w->axis_z, w->axis_x);
    n = sqrt(dot(w->axis_x, w->axis_x));
    for (int k = 0; k < 3; ++k) w->axis_x[k] /= n;
    cross(w->axis_z, w->axis_x, w->axis_y);
}

static void world_lids(struct world *w, double elevation_deg, double opening) {
    double up = w->p.lid_upper_deg + w->p.lid_upper_follow * elevation_deg;
    double low = w->p.lid_lower_deg + w->p.lid_lower_follow * elevation_deg;
    double shut = (1 - w->p.lid_close_at) * low + w->p.lid_close_at * up;
    w->lid_up = (opening * up + (1 - opening) * shut) * DEGREE;
    w->lid_low = (opening * low + (1 - opening) * shut) * DEGREE;
    w->lid_half = w->p.canthus_deg * DEGREE;
}

static void to_head(const struct world *w, const double *eye, double *head) {
    for (int k = 0; k < 3; ++k)
        head[k] = eye[0] * w->axis_x[k] + eye[1] * w->axis_y[k] + eye[2] * w->axis_z[k];
}

static void to_eye(const struct world *w, const double *head, double *eye) {
    eye[0] = dot(head, w->axis_x);
    eye[1] = dot(head, w->axis_y);
    eye[2] = dot(head, w->axis_z);
}

// Radius of the outside at an angle from the axis, and its slope: the larger of conic and globe, with a cubic
// round where they are within limbus_blend_mm of each other.
static double profile(const struct world *w, double theta, double *slope) {
    double c = cos(theta), s = sin(theta), big = w->p.cornea_radius_mm, q = w->conic,
           blend = w->p.limbus_blend_mm;
    // On the ray (t s, t c): (t s)^2 = 2 big (apex - t c) - q (apex - t c)^2.
    double aa = s * s + q * c * c, half = c * (big - q * w->apex), rest = w->apex * (q * w->apex - 2 * big);
    double t = (-half + sqrt(half * half - aa * rest)) / aa;
    double depth = w->apex - t * c, f_t = 2 * t * s * s + 2 * c * (big - q * depth);
    double f_theta = 2 * t * t * s * c - 2 * t * s * (big - q * depth);
    double t_slope = -f_theta / f_t, gap = t - w->p.globe_radius_mm;
    if (gap >= blend) return *slope = t_slope, t;
    if (gap <= -blend) return *slope = 0, w->p.globe_radius_mm;
    double e = 1 - fabs(gap) / blend;
    *slope = gap > 0 ? t_slope * (1 - e * e / 2) : t_slope * e * e / 2;
    return (gap > 0 ? t : w->p.globe_radius_mm) + blend * e * e * e / 6;
}

static double white(const struct world *w, double r) {
    return step5(0.5 + (r - w->p.limbus_radius_mm) / w->p.limbus_haze_mm);
}

static double fresnel(double index, double c) {
    double inside = sqrt(index * index - 1 + c * c);  // index times the cosine of refraction
    double s = (c - inside) / (c + inside), p = (index * index * c - inside) / (index * index * c + inside);
    return (s * s + p * p) / 2;
}

// A place between the lids, head frame.
struct lid_place {
    double above, below, radial[3], rising[3];
};

static void lid_measure(const struct world *w, const double *head, struct lid_place *at) {
    double flat = hypot(head[0], head[2]), rho = hypot(flat, head[1]);
    double alpha = atan2(head[0], -head[2]), beta = atan2(head[1], flat), a = alpha / w->lid_half;
    double tilt = w->p.canthus_tilt_deg / 45, arch = 1 - a * a, arch_slope = -2 * a / w->lid_half;
    double up = tilt * alpha + w->lid_up * arch, low = tilt * alpha + w->lid_low * arch;
    double up_run = (tilt + w->lid_up * arch_slope) * rho / flat;
    double low_run = (tilt + w->lid_low * arch_slope) * rho / flat;
    at->above = rho * (up - beta) / hypot(1, up_run);
    at->below = rho * (beta - low) / hypot(1, low_run);
    for (int k = 0; k < 3; ++k) at->radial[k] = head[k] / rho;
    double sb = head[1] / rho, cb = flat / rho;
    at->rising[0] = -sb * head[0] / flat;
    at->rising[1] = cb;
    at->rising[2] = -sb * head[2] / flat;
}

static double lids_pass(const struct world *w, const struct lid_place *at, const double *away) {
    if (at->above <= 0 || at->below <= 0) return 0;
    double rise = dot(away, at->radial), slope = dot(away, at->rising) / (rise > 0.02 ? rise : 0.02);
    double round = sqrt(slope * slope + 0.01), upper = (round + slope) / 2, lower = (round - slope) / 2;
    double soft = w->p.lid_softness_mm, thick = w->p.lid_thickness_mm;
    double pass = step5((at->above - thick * upper) / soft) * step5((at->below - thick * lower) / soft);
    if (w->p.lash_opacity > 0)
        pass *= 1 - w->p.lash_opacity * (1 - step5((at->above - w->p.lash_length_mm * upper) / soft));
    return pass;
}

// Height of the orbit's relief, and of the face with the lids' cap, over the frontal plane; with its slopes.
static double relief(const struct world *w, double x, double y) {
    double brow = (y - 21) / 7, cheek = (y + 24) / 8;
    return 4 + w->p.brow_mm * exp(-brow * brow / 2) + w->p.cheek_mm * exp(-cheek * cheek / 2) +
           w->p.nose_mm * step5((-13 - x) / 18) * (1 - 0.3 * step5((y + 2) / 20)) - 8 * step5((x - 12) / 20);
}

static double face(const struct world *w, double x, double y) {
    double big = w->p.lid_radius_mm, r = hypot(x, y), edge = 0.9 * big, foot = big * sqrt(0.19);
    double cap = r < edge ? sqrt((big - r) * (big + r)) : foot - (r - edge) * edge / foot;
    double rest = relief(w, x, y), e = 1 - fabs(cap - rest) / 3;
    return fmax(cap, rest) + (e > 0 ? e * e * e / 2 : 0);
}

static double face_slope(const struct world *w, double x, double y, int along_y) {
    // Fourth order: kinks of the second derivative cost 1e-7.
    double h = 1e-3, d[4];
    for (int i = 0; i < 4; ++i) {
        double s = (i < 2 ? i - 2 : i - 1) * h;
        d[i] = along_y ? face(w, x, y + s) : face(w, x + s, y);
    }
    return (8 * (d[2] - d[1]) - (d[3] - d[0])) / (12 * h);
}

// The soft horizon: least of gap(u) / u along P + u (Q - P), u in 0..1, or below -floor_mm, or above
// floor_mm, whatever it is then. start = the limit at u = 0.
static double gap_per_u(const struct world *w, int bare, const double *p, const double *d, double u) {
    double x = p[0] + u * d[0], y = p[1] + u * d[1];
    return (-(p[2] + u * d[2]) - (bare ? relief(w, x, y) : face(w, x, y))) / u;
}

static double horizon(const struct world *w, int bare, const double *p, const double *q, double start,
                      double floor_mm) {
    enum { STEPS = 72 };
    double d[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]}, length = sqrt(dot(d, d)), least = start;
    double reach = length < 110 ? 1 : 110 / length, u[3] = {0, 0, 0}, v[3] = {start, start, start};
    double top = 4 + w->p.brow_mm + w->p.cheek_mm + w->p.nose_mm, level = q[0] > -13 && p[0] > -13;
    if (level) top -= w->p.nose_mm;
    if (!bare && top < w->p.lid_radius_mm) top = w->p.lid_radius_mm;
    if (!bare) top += 0.5;
    for (int i = 1; i <= STEPS + 1; ++i) {
        double t = (double)i / STEPS;
        u[0] = u[1], v[0] = v[1], u[1] = u[2], v[1] = v[2];
        if (i <= STEPS) {
            u[2] = reach * t * t;
            v[2] = gap_per_u(w, bare, p, d, u[2]);
        } else {
            u[2] = 1;  // beyond the face's own size gap(u) / u is monotonic
            v[2] = reach < 1 ? gap_per_u(w, bare, p, d, 1) : v[1];
        }
        if (v[2] < least) least = v[2];
        if (least <= -floor_mm) return least;
        if (i > 1 && v[1] <= v[0] && v[1] <= v[2] && v[1] < floor_mm + 3 && u[2] > u[1]) {
            // Brent's parabola between golden sections.
            double a = u[0], b = u[2], at = u[1], best = v[1];
            double x1 = a, x2 = b, v1 = v[0], v2 = v[2];
            for (int k = 0; k < 40 && b - a > 1e-7 * at; ++k) {
                double r = (at - x1) * (best - v2), s = (at - x2) * (best - v1), bottom = 2 * (s - r), next;
                next = bottom != 0 ? at + ((at - x2) * s - (at - x1) * r) / -bottom : a;
                if (!(next > a && next < b) || fabs(next - at) < 1e-9 * at || k % 5 == 4)
                    next = b - at > at - a ? at + 0.382 * (b - at) : at - 0.382 * (at - a);
                double value = gap_per_u(w, bare, p, d, next), old = best;
                if (value < best) {
                    if (next > at)
                        a = at;
                    else
                        b = at;
                    x1 = x2, v1 = v2, x2 = at, v2 = best, at = next, best = value;
                } else {
                    if (next > at)
                        b = next;
                    else
                        a = next;
                    x1 = x2, v1 = v2, x2 = next, v2 = value;
                }
                if (k > 3 && fabs(old - value) < 1e-10) break;
            }
            if (best < least) least = best;
        }
        // All that is left lies below `top`: nothing there can come lower.
        double height = -(p[2] + u[2] * d[2]) - top;
        if (-d[2] > 0 && height > 0 && height / u[2] > fmin(least, floor_mm) && i > 1 && -p[2] < top) break;
    }
    return least;
}

// Part of a lens (centre q) that a point of the eye in this direction sees past the face.
static double face_passes(const struct world *w, const double *head, const double *q, double radius) {
    double n = sqrt(dot(head, head)), p[3], lens = radius > 0.25 ? radius : 0.25;
    for (int k = 0; k < 3; ++k) p[k] = head[k] / n * w->p.lid_radius_mm;
    if (-p[2] - relief(w, p[0], p[1]) <= 0) return 0;
    return step5(0.5 + horizon(w, 1, p, q, 1e9, lens) / (2 * lens));
}

static double rounded_cosine(double c, double half) {
    return c >= half ? c : c <= -half ? 0 : (c + half) * (c + half) / (4 * half);
}

static double window(const struct ref_port *port, const double *away) {
    double c = -dot(port->aim, away), t = tan(port->sigma_deg * DEGREE);
    return c > 1e-3 ? exp(-(1 / (c * c) - 1) / (2 * t * t)) : 0;
}

// Snell's ray from a place (eye frame) through (x, y) of the unblended cornea to the iris plane.
struct ray {
    double point[3], spot[2], jacobian[4];  // d spot / d (x, y), row by row
    double cosine, solid;                   // of incidence; solid angle at the place per area of (x, y)
};

static int refract_ray(const struct world *w, const double *from, double x, double y, struct ray *ray) {
    double big = w->p.cornea_radius_mm, root2 = big * big - w->conic * (x * x + y * y),
           n = w->p.refractive_index;
    if (root2 <= 0.02 * big * big) return 0;
    double root = sqrt(root2), *q = ray->point, u[3], normal[3], size = sqrt(x * x + y * y + root2);
    q[0] = x, q[1] = y, q[2] = w->apex - sag(w, x * x + y * y);
    normal[0] = x / size, normal[1] = y / size, normal[2] = root / size;
    double distance = toward(from, q, u), c = ray->cosine = -dot(u, normal);
    double inside = sqrt(n * n - 1 + c * c), turn = (c - inside) / n, v[3];
    for (int k = 0; k < 3; ++k) v[k] = u[k] / n + turn * normal[k];
    if (v[2] >= -1e-3) return 0;
    double t = (w->iris_z - q[2]) / v[2];
    ray->solid = c / normal[2] / (distance * distance);
    ray->spot[0] = x + t * v[0], ray->spot[1] = y + t * v[1];
    for (int axis = 0; axis < 2; ++axis) {
        double dq[3] = {axis == 0, axis == 1, -(axis ? y : x) / root}, du[3], dn[3], dv[3];
        double along = dot(u, dq), droot = -w->conic * (axis ? y : x) / root;
        double raw[3] = {axis == 0, axis == 1, droot}, part = dot(raw, normal);
        for (int k = 0; k < 3; ++k) {
            du[k] = (dq[k] - along * u[k]) / distance;
            dn[k] = (raw[k] - part * normal[k]) / size;
        }
        double dc = -dot(du, normal) - dot(u, dn), dturn = (dc - c * dc / inside) / n;
        for (int k = 0; k < 3; ++k) dv[k] = du[k] / n + dturn * normal[k] + turn * dn[k];
        double dt = (-dq[2] - t * dv[2]) / v[2];
        for (int k = 0; k < 2; ++k) ray->jacobian[2 * k + axis] = dq[k] + dt * v[k] + t * dv[k];
    }
    return 1;
}

// The ray that ends at a spot of the iris, by shooting from (guess_x, guess_y). 0 when there is none.
static int shoot(const struct world *w, const double *from, const double *spot, double x, double y,
                 struct ray *ray) {
    if (!refract_ray(w, from, x, y, ray)) return 0;
    double ex = ray->spot[0] - spot[0], ey = ray->spot[1] - spot[1], miss = hypot(ex, ey);
    for (int i = 0; i < 60 && miss > 1e-11; ++i) {
        const double *j = ray->jacobian;
        double det = j[0] * j[3] - j[1] * j[2], dx, dy, scale = 1;
        if (!(fabs(det) > 1e-9)) return 0;
        dx = -(j[3] * ex - j[1] * ey) / det;
        dy = -(j[0] * ey - j[2] * ex) / det;
        if (hypot(dx, dy) > 2) scale = 2 / hypot(dx, dy);
        struct ray next;
        int better = 0;
        for (int k = 0; k < 25 && !better; ++k, scale /= 2) {
            if (!refract_ray(w, from, x + scale * dx, y + scale * dy, &next)) continue;
            double miss_next = hypot(next.spot[0] - spot[0], next.spot[1] - spot[1]);
            better = miss_next < miss;
            if (better) x += scale * dx, y += scale * dy, miss = miss_next;
        }
        if (!better) break;
        *ray = next;
        ex = ray->spot[0] - spot[0], ey = ray->spot[1] - spot[1];
    }
    return miss < 1e-8;
}
