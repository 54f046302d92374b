// SPDX-License-Identifier: Apache-2.0
//
// The iris, seen from one port: the integrand over the part of the cornea that shows it. Included by
// reference.c.
//
// Where a port is so low that rays through the cornea fold on the iris, a spot has two paths; the model's is
// the shorter one (positive Jacobian). Tracing starts from such an end: the caustic is then no singularity.
enum { SLOTS = 4, STARTS = 40 };

struct seen {         // how one port sees the iris
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
        double x = (2 * (k % STARTS + 0.5) / STARTS - 1) * reach,
               y = (2 * (k / STARTS + 0.5) / STARTS - 1) * reach;
        struct ray ray;
        if (hypot(x, y) > reach || !refract_ray(w, seen->place, x, y, &ray) || ray.cosine < -0.02) continue;
        if (hypot(ray.spot[0], ray.spot[1]) < rim && determinant(&ray) < 0.03) seen->folds = 1;
        if (ray.cosine <= 0 || determinant(&ray) <= 0) continue;
        double start[4] = {ray.spot[0], ray.spot[1], x, y};
        memcpy(seen->starts[seen->n_starts++], start, sizeof start);
    }
    return 0;
}

static int is_shortest(const struct ray *ray) {
    return ray->cosine > 0 && determinant(ray) > 0;
}

// The shortest path between a port and a spot.
static int find_path(const struct world *w, struct seen *seen, const double *spot, struct ray *ray) {
    struct ray *last = &seen->last;
    int found = 0;
    if (seen->has_last) {
        const double *j = last->jacobian;
        double det = determinant(last), ex = spot[0] - last->spot[0], ey = spot[1] - last->spot[1];
        double dx = (j[3] * ex - j[1] * ey) / det, dy = (j[0] * ey - j[2] * ex) / det;
        if (hypot(dx, dy) < 1)
            found = shoot(w, seen->place, spot, last->point[0] + dx, last->point[1] + dy, ray);
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
            slope =
                (ray.spot[0] * (j[0] * c + j[1] * s) + ray.spot[1] * (j[2] * c + j[3] * s)) / (r + 1e-300);
        }
        if (f > 0)
            high = t;
        else
            low = t;
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
                if (here == was)
                    low = mid;
                else
                    high = mid;
            }
            if (is && iris->n_slots == SLOTS) return;
            if (is)
                iris->slot[iris->n_slots][0] = iris->slot[iris->n_slots][1] = high;
            else
                iris->slot[iris->n_slots++][1] = low;
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
        if (from->folds)
            line_row(iris, row);
        else
            polar_row(iris, row);
        iris->row = row;
    }
    int slot = (int)t;
    if (slot >= iris->n_slots) return;
    double length = iris->slot[slot][1] - iris->slot[slot][0], r = iris->slot[slot][0] + (t - slot) * length;
    double x = iris->centre[0] + r * cos(row), y = iris->centre[1] + r * sin(row), weight = length * r;
    if (from->folds) {
        double far = hypot(from->place[0], from->place[1]), c = from->place[0] / far,
               s = from->place[1] / far;
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
    cubature_grid(c, 0, 1, 2, 0, 2 * PI, 6);
}
