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
enum { FEWEST = 3, ARCS = 2, MOST_PANELS = 128 };

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

static void add_arcs(const struct sim_lobe *lobe, const struct sim_ring *ring, double step, double weight) {
    const struct sim_scene *scene = lobe->gaze->scene;
    double arcs[ARCS][2];
    int n = arcs_seen(lobe, ring, arcs);
    for (int i = 0; i < n; ++i) {
        double width = arcs[i][1] - arcs[i][0], widths = 1.4 * width / step;
        int panels = (int)ceil(widths / 5), points = panel_points(scene, widths / panels);
        const double *x = scene->rule[points], *w = x + points;
        for (int j = 0; j < panels * points; ++j) {
            double half = width / (2 * panels);
            double phi = arcs[i][0] + half * (2 * (j / points) + 1 + x[j % points]);
            sim_lobe_point(lobe, ring, cos(phi), sin(phi), weight * half * w[j % points]);
        }
    }
}

// Adds points of equal steps from an azimuth to both sides, steps low..high; stops, if it may, where the lobe
// is out of reach and getting further. On return low..high are the steps taken.
static void march(const struct sim_lobe *lobe, const struct sim_ring *ring, const struct sim_facing *at,
                  double step, int may_stop, double weight, int *low, int *high) {
    double cs = cos(step), sn = sin(step), middle = sim_lobe_point(lobe, ring, at->c, at->s, weight);
    for (int side = -1; side <= 1; side += 2) {
        double c = at->c, s = at->s, before = middle;
        int last = side < 0 ? -*low : *high;
        for (int j = 1; j <= last; ++j) {
            double turned = c * cs - side * s * sn;
            s = s * cs + side * c * sn;
            c = turned;
            double now = sim_lobe_point(lobe, ring, c, s, weight);
            if (may_stop && now > lobe->cut && now >= before) {
                *(side < 0 ? low : high) = side * j;
                break;
            }
            before = now;
        }
    }
}

static void add_ring(struct sim_lobe *lobe, double theta, double weight) {
    const struct sim_scene *scene = lobe->gaze->scene;
    struct sim_ring ring;
    sim_ring_at(&scene->eye, theta, &ring);
    sim_ring_face(&ring, lobe->a, lobe->b, lobe->near, &lobe->start);
    const struct sim_facing *at = &lobe->start;
    double reach = sqrt(lobe->cut) * lobe->alpha;
    if (fabs(at->miss) > 1.3 * reach) return;
    weight *= ring.area;
    // Round the axis the lobe lies across the ring, and the slope is nowhere steep but turns.
    int axial = at->pace < 6 * reach;
    double width = lobe->alpha / (at->pace + axial * fabs(at->miss) + 1e-9), most = 0.5 / (ring.r + 1e-9);
    if (width > most) width = most;
    double sine = sqrt(fmax(0, 1 - at->cosine * at->cosine));
    if (at->cosine < 2 * reach * sine) {
        add_arcs(lobe, &ring, width, weight);
        return;
    }
    int n = (int)ceil(2 * PI / (0.9 * width) * sqrt(scene->quality.glint));
    if (n < 10) n = 10;
    double step = 2 * PI / n;
    int low = -((n - 1) / 2), high = n / 2;
    if (n <= 48) {
        march(lobe, &ring, at, step, 0, weight * step, &low, &high);
        return;
    }
    int covered[2] = {low, high};
    march(lobe, &ring, at, step, 1, weight * step, &covered[0], &covered[1]);
    if (!axial) return;
    // A second azimuth may be as near.
    struct sim_facing other = {.c = -at->c, .s = -at->s};
    sim_ring_face(&ring, lobe->a, lobe->b, lobe->near, &other);
    double angle = atan2(other.s * at->c - other.c * at->s, other.c * at->c + other.s * at->s);
    int index = (int)floor(angle / step + 0.5), from = covered[1] + 1, to = covered[0] - 1 + n;
    if (index < covered[0]) index += n;
    if (fabs(other.miss) > 1.3 * reach || index < from || index > to) return;
    other.c = at->c * cos(index * step) - at->s * sin(index * step);
    other.s = at->s * cos(index * step) + at->c * sin(index * step);
    low = from - index;
    high = to - index;
    march(lobe, &ring, &other, step, 1, weight * step, &low, &high);
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

static void add_stretch(struct sim_lobe *lobe, const struct sim_stretch *stretch) {
    double reach = sqrt(lobe->cut) * lobe->alpha, from = stretch->from;
    // Only a wide lobe or grazing light reaches a horizon: else no arc opens or closes in it that matters.
    struct sim_ring ring;
    sim_ring_at(&lobe->gaze->scene->eye, (stretch->from + stretch->to) / 2, &ring);
    sim_ring_face(&ring, lobe->a, lobe->b, lobe->near, &lobe->start);
    int wide = reach > 0.3 || lobe->start.cosine < 0.3 + 2 * reach;
    int pieces = wide ? (int)ceil((stretch->to - stretch->from) / 0.04) : 0;
    for (int i = 0; i < pieces; ++i) {
        double lo = stretch->from + (stretch->to - stretch->from) * i / pieces;
        double hi = stretch->from + (stretch->to - stretch->from) * (i + 1) / pieces;
        int kind = arcs_kind(lobe, lo);
        if (arcs_kind(lobe, hi) == kind) continue;
        for (int j = 0; j < 40; ++j) {
            double mid = (lo + hi) / 2;
            if (arcs_kind(lobe, mid) == kind) lo = mid;
            else hi = mid;
        }
        add_panels(lobe, from, lo, stretch->steepest);
        from = lo;
    }
    add_panels(lobe, from, stretch->to, stretch->steepest);
}

static void add_pair(struct sim_gaze *gaze, int a, int b) {
    const struct sim_scene *scene = gaze->scene;
    double rough = scene->person.roughness, fine = log(scene->quality.glint);
    struct sim_lobe lobe = {.gaze = gaze, .a = gaze->sites[a], .b = gaze->sites[b], .site_a = a, .site_b = b};
    lobe.alpha2 = rough * rough + gaze->widen[a] + gaze->widen[b];
    lobe.alpha = sqrt(lobe.alpha2);
    lobe.cut = fmin(fmax(11 + 6 * fine, 5), 30);
    lobe.near = fmin(0.3 * lobe.alpha, 0.03);
    sim_facing_start(lobe.a, lobe.b, &lobe.start);
    struct sim_stretch stretches[SIM_STRETCHES];
    double reach = sqrt(lobe.cut) * lobe.alpha;
    // Of a wide lobe the linear miss is but an estimate.
    int n = sim_profile_scan(&scene->profile, &scene->eye, lobe.a, lobe.b, reach * (1 + fmin(reach, 0.2)),
                             stretches);
    int cheap = n && scene->quality.tolerance > 0 && sim_lobe_by_mirror(&lobe, stretches, n);
    ++gaze->counts[cheap ? 0 : n ? 1 : 2];
    for (int i = 0; i < n && !cheap; ++i) add_stretch(&lobe, &stretches[i]);
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
