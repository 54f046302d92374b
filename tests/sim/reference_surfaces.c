// SPDX-License-Identifier: Apache-2.0
//
// Skin and sclera: the integrands over (x, y) and over (theta, phi). Included by reference.c.
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
    double point[3] = {x, y, -face(w, x, y)}, slope_x = face_slope(w, x, y, 0),
           slope_y = face_slope(w, x, y, 1);
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
    double on_lids = 1 - step5((rho - w->p.lid_radius_mm - 1) / 1.5);
    for (int s = 0; s < scene->n_worlds; ++s) {
        struct lid_place at;
        skin[s] = 1;
        if (!lid) continue;
        lid_measure(&scene->worlds[s], point, &at);
        skin[s] -=
            on_lids * step5(at.above / w->p.lid_softness_mm) * step5(at.below / w->p.lid_softness_mm);
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
            double d[3] = {q[0] - point[0], q[1] - point[1], q[2] - point[2]},
                   tangent = dot(d, normal) * size;
            if (tangent <= -lens)
                share[same] = 1;
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
    double eye[3] = {rho * s * cos(phi), rho * s * sin(phi), rho * c},
           n[3] = {out * cos(phi), out * sin(phi), up};
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
    if (weight <= 0 || at.above <= 0 || at.below <= 0 || !ports_at(scene, point, normal, factor, away))
        return;
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
