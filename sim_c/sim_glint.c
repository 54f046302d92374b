// SPDX-License-Identifier: Apache-2.0
//
// The glint: light that the eye's front mirrors from an emitter into a sensor,
//     integral of D(n.h) F(l.h) / 4 * beam / d_l^2 * window / d_v^2 over the surface,
// D Beckmann's distribution. The integral is taken where the lobe is and nowhere else: along the profile over
// the stretches in which some azimuth's slope is within reach (sim_mirror.h), by Gauss-Legendre panels as
// long as the slope's change across them allows; around each ring by the midpoint rule, which for a compact
// smooth lobe converges faster than any power of its step, outward from the least slope until it is out of
// reach. Cost so depends on the number of lobes, not on their width. Where a site sets behind the eye's own
// horizon within the lobe, the ring's visible arcs get panels of their own.
#include <math.h>
#include <stdatomic.h>
#include <string.h>

#include "sim_glint.h"

#define PI 3.14159265358979323846
enum { FEWEST = 3, ARCS = 2, MOST_PANELS = 128, MOST_STEPS = 1 << 17 };

double sim_gaze_window(const double aim[3], double per_tan2, const double away[3]) {
    double c = -sim_dot(aim, away);
    if (c < 0.03) return 0;
    double t = (1 - c * c) / (c * c) * per_tan2;
    return t > 40 ? 0 : exp(-t);
}

// The lids' and the face's share of a point: open[lid]. Returns whether anything is left.
int sim_lobe_open(const struct sim_lobe *lobe, const double point[3], const double l[3], const double v[3],
                    double *open) {
    const struct sim_gaze *gaze = lobe->gaze;
    const double *axes = gaze->axes;
    double head[3], away[2][3], alpha, beta;
    for (int i = 0; i < 3; ++i) {
        head[i] = axes[3 * i] * point[0] + axes[3 * i + 1] * point[1] + axes[3 * i + 2] * point[2];
        away[0][i] = axes[3 * i] * l[0] + axes[3 * i + 1] * l[1] + axes[3 * i + 2] * l[2];
        away[1][i] = axes[3 * i] * v[0] + axes[3 * i + 1] * v[1] + axes[3 * i + 2] * v[2];
    }
    struct sim_lid_point at;
    double rho = sim_lid_locate(head, &at, &alpha, &beta), any = 0;
    for (int i = 0; i < gaze->n_lids; ++i) {
        sim_lid_measure(&gaze->lids[i], alpha, beta, rho, &at);
        open[i] = sim_lid_open_toward(&gaze->lids[i], &at, away[0]);
        if (open[i] > 0) open[i] *= sim_lid_open_toward(&gaze->lids[i], &at, away[1]);
        any += open[i];
    }
    if (any == 0) return 0;
    const struct sim_face *face = &gaze->scene->face;
    double reach = sim_face_eye_reach(face, lobe->site_a, alpha, beta);
    if (reach > 0) reach *= sim_face_eye_reach(face, lobe->site_b, alpha, beta);
    for (int i = 0; i < gaze->n_lids; ++i) open[i] *= reach;
    return reach > 0;
}

// Adds weight times all that varies with the ports.
static void add_ports(const struct sim_lobe *lobe, double weight, const double l[3], const double v[3],
                      const double *open) {
    const struct sim_gaze *gaze = lobe->gaze;
    const struct sim_scene *scene = gaze->scene;
    int m = scene->n_emitters, pairs = scene->n_sensors * m;
    double *apart = lobe->apart;
    for (int s = 0; s < scene->n_sensors; ++s) {
        int site = scene->sensors[s].site, here = site == lobe->site_a;
        if (!here && site != lobe->site_b) continue;
        double ws = sim_gaze_window(gaze->sensor_aim[s], scene->sensors[s].per_tan2, here ? l : v);
        if (ws == 0 && !apart) continue;
        for (int e = 0; e < m; ++e) {
            // A pair belongs to this view when its two ends are the view's two sites.
            if (scene->emitters[e].site != (here ? lobe->site_b : lobe->site_a)) continue;
            double w = sim_gaze_window(gaze->emitter_aim[e], scene->emitters[e].per_tan2, here ? v : l);
            w *= ws * weight;
            double *to = apart ? apart : gaze->out + s * m + e;
            for (int i = 0; i < gaze->n_lids; ++i) to[apart ? i : i * pairs] += w * open[i];
            if (apart) apart += gaze->n_lids;
        }
    }
}

// Adds the integrand at an azimuth (cosine, sine). Returns slope^2 / alpha^2 there, large behind a horizon.
double sim_lobe_point(const struct sim_lobe *lobe, const struct sim_ring *ring, double c, double s,
                        double weight) {
    double point[3] = {ring->r * c, ring->r * s, ring->z}, l[3], v[3], h[3];
    double normal[3] = {ring->n_out * c, ring->n_out * s, ring->n_up};
    for (int k = 0; k < 3; ++k) {
        l[k] = lobe->a[k] - point[k];
        v[k] = lobe->b[k] - point[k];
    }
    double da2 = sim_dot(l, l), db2 = sim_dot(v, v), ka = 1 / sqrt(da2), kb = 1 / sqrt(db2);
    for (int k = 0; k < 3; ++k) {
        l[k] *= ka;
        v[k] *= kb;
        h[k] = l[k] + v[k];
    }
    double nl = sim_dot(normal, l), nv = sim_dot(normal, v), hn = nl + nv, h2 = sim_dot(h, h);
    // |n x h|^2 / (n.h)^2 without the cancellation of 1 - cos^2.
    double x[3] = {normal[1] * h[2] - normal[2] * h[1], normal[2] * h[0] - normal[0] * h[2],
                   normal[0] * h[1] - normal[1] * h[0]};
    double slope2 = hn > 0 ? sim_dot(x, x) / (hn * hn * lobe->alpha2) : 1e30;
    if (slope2 > lobe->cut || nl <= 0 || nv <= 0) return slope2;
    double open[SIM_MAX_LIDS];
    if (!sim_lobe_open(lobe, point, l, v, open)) return slope2;
    double c2 = hn * hn / h2, peak = exp(-slope2) / (PI * lobe->alpha2 * c2 * c2);
    weight *= peak * sim_fresnel(lobe->gaze->scene->eye.index, sqrt(h2) / 2) / (4 * da2 * db2);
    add_ports(lobe, weight, l, v, open);
    return slope2;
}

// Visible arc of a ring from a site, centred on the site's azimuth: its half width, 0..PI.
static double arc_seen(const struct sim_ring *ring, const double site[3]) {
    double flat = ring->n_out * sqrt(site[0] * site[0] + site[1] * site[1]);
    double level = ring->n_out * ring->r + ring->n_up * (ring->z - site[2]);
    if (level >= flat) return 0;
    return level <= -flat ? PI : acos(level / flat);
}

// The arcs of a ring that see both sites: [from, to] pairs. Returns their number.
static int arcs_seen(const struct sim_lobe *lobe, const struct sim_ring *ring, double arcs[ARCS][2]) {
    double wa = arc_seen(ring, lobe->a), wb = arc_seen(ring, lobe->b);
    double at = atan2(lobe->a[1], lobe->a[0]), off = atan2(lobe->b[1], lobe->b[0]) - at;
    off -= 2 * PI * floor(off / (2 * PI) + 0.5);
    int n = 0;
    for (int turn = -1; turn <= 1; ++turn) {
        double from = fmax(-wa, off + 2 * PI * turn - wb), to = fmin(wa, off + 2 * PI * turn + wb);
        if (wb >= PI) from = -wa, to = wa;
        if (to <= from || n == ARCS) continue;
        arcs[n][0] = at + from;
        arcs[n++][1] = at + to;
        if (wb >= PI) break;
    }
    return n;
}

// Points of a Gauss-Legendre panel across which the slope changes by so many lobe widths.
static int panel_points(const struct sim_scene *scene, double widths) {
    int n = (int)ceil((2.6 + 1.6 * widths) * sqrt(scene->quality.glint));
    return n < FEWEST ? FEWEST : n > SIM_MAX_RULE ? SIM_MAX_RULE : n;
}

// Whether some cell of the ring covers a part of an arc, which may run past a whole turn.
static int covered(const struct sim_lobe *lobe, double theta, double from, double to) {
    for (int i = lobe->first; i < lobe->last; ++i) {
        const struct sim_cell *cell = &lobe->cells[i];
        if (cell->from > theta || cell->to <= theta) continue;
        double off = floor(from - cell->lo);
        for (int turn = 0; turn <= 2; ++turn)
            if (cell->lo + off + turn <= to && cell->hi + off + turn >= from) return 1;
    }
    return 0;
}

static void add_arcs(const struct sim_lobe *lobe, const struct sim_ring *ring, double step, double weight) {
    const struct sim_scene *scene = lobe->gaze->scene;
    double arcs[ARCS][2];
    int n = arcs_seen(lobe, ring, arcs);
    for (int i = 0; i < n; ++i) {
        double width = arcs[i][1] - arcs[i][0], widths = fmin(1.4 * width / step, 5.0 * MOST_PANELS * 16);
        int panels = (int)ceil(widths / 5);
        if (panels < 1) panels = 1;
        int points = panel_points(scene, widths / panels);
        const double *x = scene->rule[points], *w = x + points;
        double half = width / (2 * panels);
        for (int k = 0; k < panels; ++k) {
            double from = arcs[i][0] + 2 * k * half;
            if (!covered(lobe, ring->theta, from / (2 * PI), (from + 2 * half) / (2 * PI))) continue;
            for (int j = 0; j < points; ++j) {
                double phi = from + half * (1 + x[j]);
                sim_lobe_point(lobe, ring, cos(phi), sin(phi), weight * half * w[j]);
            }
        }
    }
}

// Adds the ring at theta: equal steps around it, of which those in cells of the cover are taken.
static void add_ring(struct sim_lobe *lobe, double theta, double weight) {
    const struct sim_scene *scene = lobe->gaze->scene;
    const struct sim_cell *found[SIM_COVER_CELLS];
    double bend = 0;
    int edge = 0, n_found = 0;
    for (int i = lobe->first; i < lobe->last && lobe->cells[i].from <= theta; ++i) {
        const struct sim_cell *cell = &lobe->cells[i];
        if (cell->to <= theta) continue;
        int j = n_found++;
        for (; j > 0 && found[j - 1]->lo > cell->lo; --j) found[j] = found[j - 1];
        found[j] = cell;
        bend = fmax(bend, cell->bend);
        edge |= cell->edge;
    }
    if (!n_found) return;
    struct sim_ring ring;
    sim_ring_at(&scene->eye, theta, &ring);
    weight *= ring.area;
    double width = lobe->alpha / (fabs(ring.n_out) + ring.r * bend + 1e-9);
    if (width > 0.33 / (ring.r + 1e-9)) width = 0.33 / (ring.r + 1e-9);
    if (edge) {
        add_arcs(lobe, &ring, width, weight);
        return;
    }
    int n = (int)ceil(fmin(2 * PI / (0.9 * width) * sqrt(scene->quality.glint), MOST_STEPS));
    if (n < 10) n = 10;
    double step = 2 * PI / n, cs = cos(step), sn = sin(step);
    for (int i = 0, next; i < n_found; i = next) {
        for (next = i + 1; next < n_found && found[next]->lo == found[next - 1]->hi;) ++next;
        int from = (int)ceil(found[i]->lo * n), to = (int)ceil(found[next - 1]->hi * n);
        if (from == to) continue;
        double c = cos(from * step), s = sin(from * step);
        for (int j = from; j < to; ++j) {
            sim_lobe_point(lobe, &ring, c, s, weight * step);
            double turned = c * cs - s * sn;
            s = s * cs + c * sn;
            c = turned;
        }
    }
}

// How a ring is seen: changes where an arc appears or closes, which is where panels must end.
static int arcs_kind(const struct sim_lobe *lobe, double theta) {
    struct sim_ring ring;
    double arcs[ARCS][2];
    sim_ring_at(&lobe->gaze->scene->eye, theta, &ring);
    int full = 4 * (arc_seen(&ring, lobe->a) >= PI) + 8 * (arc_seen(&ring, lobe->b) >= PI);
    return full + arcs_seen(lobe, &ring, arcs);
}

static void add_panels(struct sim_lobe *lobe, double from, double to, double steepest) {
    const struct sim_scene *scene = lobe->gaze->scene;
    double widths = (to - from) * steepest / lobe->alpha, length = (to - from) * scene->eye.apex;
    int panels = (int)ceil(fmin(fmax(widths / 12, length / 4), MOST_PANELS));
    if (panels < 1) panels = 1;
    int points = panel_points(scene, fmax(widths, length / 0.5) / panels);
    const double *x = scene->rule[points], *w = x + points;
    double half = (to - from) / (2 * panels);
    for (int j = 0; j < panels * points; ++j)
        add_ring(lobe, from + half * (2 * (j / points) + 1 + x[j % points]), half * w[j % points]);
}

// Adds the cells first..last of the cover, whose thetas are one interval of one piece of the profile.
static void add_stretch(struct sim_lobe *lobe, double from, double end) {
    double steepest = 0;
    int edge = 0;
    for (int i = lobe->first; i < lobe->last; ++i) {
        steepest = fmax(steepest, lobe->cells[i].steep);
        edge |= lobe->cells[i].edge;
    }
    // Only at a horizon does an arc open or close.
    int pieces = edge ? (int)ceil((end - from) / 0.04) + 8 : 0;
    double begin = from;
    for (int i = 0; i < pieces; ++i) {
        double lo = begin + (end - begin) * i / pieces, hi = begin + (end - begin) * (i + 1) / pieces;
        int kind = arcs_kind(lobe, lo);
        if (arcs_kind(lobe, hi) == kind) continue;
        for (int j = 0; j < 40; ++j) {
            double mid = (lo + hi) / 2;
            if (arcs_kind(lobe, mid) == kind) lo = mid;
            else hi = mid;
        }
        add_panels(lobe, from, lo, steepest);
        from = lo;
    }
    add_panels(lobe, from, end, steepest);
}

static int by_mirror(struct sim_lobe *lobe, int n_cells, double reach) {
    const struct sim_scene *scene = lobe->gaze->scene;
    struct sim_stretch stretches[SIM_STRETCHES];
    double lo = 1, hi = 0, inner = 4;
    for (int i = 0; i < n_cells; ++i) {
        lo = fmin(lo, lobe->cells[i].lo);
        hi = fmax(hi, lobe->cells[i].hi);
        inner = fmin(inner, lobe->cells[i].from);
    }
    // One azimuth only, and not round the axis.
    if (inner == 0 || hi - lo > 0.3) return 0;
    int n = sim_profile_scan(&scene->profile, &scene->eye, lobe->a, lobe->b, reach, stretches);
    return n && sim_lobe_by_mirror(lobe, stretches, n);
}

static void add_pair(struct sim_gaze *gaze, int a, int b) {
    const struct sim_scene *scene = gaze->scene;
    double rough = scene->person.roughness, fine = log(scene->quality.glint);
    struct sim_cell cells[SIM_COVER_CELLS];
    struct sim_lobe lobe = {.gaze = gaze, .a = gaze->sites[a], .b = gaze->sites[b], .site_a = a, .site_b = b};
    lobe.cells = cells;
    lobe.alpha2 = rough * rough + gaze->widen[a] + gaze->widen[b];
    lobe.alpha = sqrt(lobe.alpha2);
    lobe.cut = fmin(fmax(11 + 6 * fine, 5), 30);
    sim_facing_start(lobe.a, lobe.b, &lobe.start);
    double reach = sqrt(lobe.cut) * lobe.alpha;
    int n = sim_cover(&scene->profile, &scene->eye, lobe.a, lobe.b, reach, cells);
    int cheap = n && scene->quality.tolerance > 0 && by_mirror(&lobe, n, reach);
    ++gaze->counts[cheap ? 0 : n ? 1 : 2];
    for (int i = 0, next; i < n && !cheap; i = next) {
        double to = cells[i].to;
        for (next = i + 1; next < n && cells[next].piece == cells[i].piece && cells[next].from <= to; ++next)
            to = fmax(to, cells[next].to);
        lobe.first = i;
        lobe.last = next;
        add_stretch(&lobe, cells[i].from, to);
    }
}

static int pair_used(const struct sim_scene *scene, int a, int b) {
    int sa = 0, sb = 0, ea = 0, eb = 0;
    for (int s = 0; s < scene->n_sensors; ++s)
        sa |= scene->sensors[s].site == a, sb |= scene->sensors[s].site == b;
    for (int e = 0; e < scene->n_emitters; ++e)
        ea |= scene->emitters[e].site == a, eb |= scene->emitters[e].site == b;
    return (sa && eb) || (sb && ea);
}

static void turn_to_eye(const double axes[9], const double head[3], double eye[3]) {
    for (int j = 0; j < 3; ++j) eye[j] = axes[j] * head[0] + axes[3 + j] * head[1] + axes[6 + j] * head[2];
}

int sim_gaze_open(struct sim_gaze *gaze, const struct sim_scene *scene, double azimuth_deg,
                  double elevation_deg, const double *lid_opening, int n_lids) {
    if (n_lids < 1 || n_lids > SIM_MAX_LIDS || !(fabs(azimuth_deg) <= 60 && fabs(elevation_deg) <= 60))
        return -1;
    gaze->scene = scene;
    gaze->n_lids = n_lids;
    for (int i = 0; i < n_lids; ++i) {
        if (!(lid_opening[i] >= 0 && lid_opening[i] <= 1)) return -1;
        sim_lid_pose(&gaze->lids[i], &scene->person, elevation_deg, lid_opening[i]);
    }
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, gaze->axes);
    for (int k = 0; k < scene->n_sites; ++k) {
        double *at = gaze->sites[k];
        turn_to_eye(gaze->axes, scene->sites[k].position, at);
        double d[3] = {at[0], at[1], at[2] - scene->eye.apex + scene->eye.radius};
        double half = scene->sites[k].radius / (2 * (sqrt(sim_dot(d, d)) - 0.9 * scene->eye.radius));
        gaze->widen[k] = half * half / 2;
    }
    for (int s = 0; s < scene->n_sensors; ++s)
        turn_to_eye(gaze->axes, scene->sensors[s].aim, gaze->sensor_aim[s]);
    for (int e = 0; e < scene->n_emitters; ++e)
        turn_to_eye(gaze->axes, scene->emitters[e].aim, gaze->emitter_aim[e]);
    return 0;
}

int sim_scene_glint(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                    const double *lid_opening, int n_lids, double *out) {
    struct sim_gaze gaze;
    if (sim_gaze_open(&gaze, scene, azimuth_deg, elevation_deg, lid_opening, n_lids)) return -1;
    gaze.out = out;
    memset(gaze.counts, 0, sizeof gaze.counts);
    memset(out, 0, (size_t)(n_lids * scene->n_sensors * scene->n_emitters) * sizeof *out);
    for (int a = 0; a < scene->n_sites; ++a)
        for (int b = a; b < scene->n_sites; ++b)
            if (pair_used(scene, a, b)) add_pair(&gaze, a, b);
    // The counts are all that a scene remembers of being used.
    for (int i = 0; i < 3; ++i)
        if (gaze.counts[i]) atomic_fetch_add(&((struct sim_scene *)scene)->glint_counts[i], gaze.counts[i]);
    return 0;
}

void sim_scene_glint_counts(const struct sim_scene *scene, long long counts[3]) {
    for (int i = 0; i < 3; ++i) counts[i] = atomic_load(&((struct sim_scene *)scene)->glint_counts[i]);
}
