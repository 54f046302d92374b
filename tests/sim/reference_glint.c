// SPDX-License-Identifier: Apache-2.0
//
// The glint of one pair: the integrand over (theta, phi) and the search for the lobe. Included by
// reference.c.
static const double THETA_END = 105 * DEGREE;  // where the surface ends for the glint

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
        double theta = from + (i - 1) * step, slope, rho = profile(w, theta, &slope),
               tilt = theta - atan2(slope, rho);
        if (i && fabs(tilt - last) > most * step) most = fabs(tilt - last) / step;
        last = tilt;
    }
    return 1.2 * most + 0.05;
}

// Hand to the cubature every part of the rectangle on which the lobe may be, small against the lobe.
static void search_lobe(struct cubature *c, const struct glint *g, double x0, double x1, double y0,
                        double y1) {
    double theta = (x0 + x1) / 2, phi = (y0 + y1) / 2, half_x = (x1 - x0) / 2, half_y = (y1 - y0) / 2;
    double radius, point[3], normal[3], away[2][3], slope, rho = profile(g->w, theta, &slope), h[3],
                                                           turn_h = 0;
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
