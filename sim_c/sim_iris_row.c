// SPDX-License-Identifier: Apache-2.0
//
// One row of the iris: cut where lids, shadows and the edges of what low sites light begin or end, Gauss's
// rule on each piece.
#include "sim_iris.h"

// At fineness 1: nodes of a piece, more where it ends at an edge, mm between them; where the veil or a lid's
// edge is in mm per haze and softness.
static const double NODES_ROW = 2, NODES_EDGE = 1, STEP_ROW = 1.0, STEP_VEIL = 0.4, STEP_EDGE = 0.3;

SIM_WIDE void sim_iris_look(const struct sim_lid *lid, const struct sim_light *light, int k, double *lower,
                          double *upper, double *full_lower, double *full_upper) {
    const double *alpha = light->alpha + k * SIM_BATCH, *beta = light->beta + k * SIM_BATCH;
    const double *rho = light->distance + k * SIM_BATCH;
    const double *out = light->out + k * SIM_BATCH, *tangent = light->tangent + k * SIM_BATCH;
    double per_half2 = 1 / (lid->half * lid->half), half = lid->thickness / 2, soft = lid->softness;
    double tilt = lid->tilt, upper_at = lid->upper, lower_at = lid->lower;
    SIM_EACH(p, SIM_SAMPLES) {
        double arch = 1 - alpha[p] * alpha[p] * per_half2, line = tilt * alpha[p], o = out[p], t = tangent[p];
        double size = sqrt(t * t + 0.01 * o * o);
        upper[p] = o * rho[p] * (line + upper_at * arch - beta[p]) - half * (size + t);
        lower[p] = o * rho[p] * (beta[p] - line - lower_at * arch) - half * (size - t);
        full_upper[p] = upper[p] - o * soft;
        full_lower[p] = lower[p] - o * soft;
    }
}

// A stretch of a row between edges of what sites light. Light rises from an edge like a root or like its
// inverse: either is smooth in t, 0..1.
struct stretch {
    double from, length;
    int rises, falls;  // an edge at the lower end, at the upper end
};

static double stretch_at(const struct stretch *s, double t, double *rate) {
    if (s->rises && s->falls) {
        *rate = s->length * 6 * t * (1 - t);
        return s->from + s->length * t * t * (3 - 2 * t);
    }
    if (s->rises || s->falls) {
        double u = s->rises ? t : 1 - t, part = u * u;
        *rate = s->length * 2 * u;
        return s->from + s->length * (s->rises ? part : 1 - part);
    }
    *rate = s->length;
    return s->from + s->length * t;
}

static double stretch_of(const struct stretch *s, double v) {
    double part = fmin(1, fmax(0, (v - s->from) / s->length));
    if (s->rises && s->falls) return 0.5 - sin(asin(1 - 2 * part) / 3);
    if (s->rises) return sqrt(part);
    return s->falls ? 1 - sqrt(1 - part) : part;
}

// Spots along a stretch of a row, from end to end.
static void probe_row(struct sim_iris *iris, int k, const struct stretch *stretch, double u) {
    for (int p = 0; p < SIM_SAMPLES; ++p) {
        double rate, v = stretch_at(stretch, p / (SIM_SAMPLES - 1.0), &rate);
        iris->probe.x[p] = u * iris->across[0] + v * iris->up[0];
        iris->probe.y[p] = u * iris->across[1] + v * iris->up[1];
    }
    iris->probe.n = SIM_SAMPLES;
    const struct sim_eye *eye = &iris->scene->eye;
    const double *site = iris->sites[k];
    double *transfer = iris->light->transfer;
    sim_cornea_refract(eye, site, SIM_PROBE_STEPS, &iris->probe, transfer);
    if (stretch->rises || stretch->falls) sim_cornea_mend(eye, site, 1, NULL, &iris->probe, transfer);
    sim_iris_locate(iris->axes, iris->scene->sites[k].position, &iris->probe, k, iris->light);
}

void sim_iris_probe(struct sim_iris *iris, int k, double radius, double u) {
    double chord = sqrt(fmax(0, radius * radius - u * u));
    struct stretch whole = {-chord, 2 * chord, 0, 0};
    probe_row(iris, k, &whole, u);
}

// The stretches of a row between given edges; returns their number.
static int cut_row(double chord, const double *edges, int n, struct stretch out[SIM_ROW_EDGES + 1]) {
    double at[SIM_ROW_EDGES + 2] = {-chord};
    int parts = 1;
    for (int i = 0; i < n; ++i) {
        if (fabs(edges[i]) >= chord) continue;
        int j = parts++;
        for (; j > 1 && at[j - 1] > edges[i]; --j) at[j] = at[j - 1];
        at[j] = edges[i];
    }
    at[parts] = chord;
    for (int i = 0; i < parts; ++i) {
        struct stretch made = {at[i], at[i + 1] - at[i], i > 0, i + 1 < parts};
        out[i] = made;
    }
    return parts;
}

// Whether a site's rays reach a row at v.
static int is_lit(const struct sim_iris *iris, int k, double u, double v) {
    double spot[3] = {u * iris->across[0] + v * iris->up[0], u * iris->across[1] + v * iris->up[1],
                      iris->scene->eye.iris_z};
    double exit[3];
    return sim_eye_refract(&iris->scene->eye, iris->sites[k], spot, exit) > 0;
}

// What a site lights of a row, as far as its edges tell. Returns 0 when that is nothing. A stretch counts as
// dark when several places of it are: of what a site beyond 95 degrees lights, edges may be missing.
static int lit_stretch(struct sim_iris *iris, int k, double chord, double u, const double *edges, int n,
                       struct stretch *out) {
    struct stretch part[SIM_ROW_EDGES + 1];
    int parts = cut_row(chord, edges, n, part), found = 0;
    for (int i = 0; i < parts; ++i) {
        static const double PLACES[] = {0.5, 0.02, 0.98, 0.25, 0.75, 0.1, 0.9};
        const int most = (int)(sizeof PLACES / sizeof *PLACES);
        double from = part[i].from, length = part[i].length;
        int tried = 0;
        while (parts > 1 && tried < most && !is_lit(iris, k, u, from + PLACES[tried] * length)) ++tried;
        if (tried == most && iris->n_unlit < SIM_ROW_EDGES) {
            iris->unlit[iris->n_unlit].site = k;
            iris->unlit[iris->n_unlit].from = part[i].from;
            iris->unlit[iris->n_unlit++].to = part[i].from + part[i].length;
        }
        if (tried) continue;
        if (!found || part[i].length > out->length) *out = part[i];
        found = 1;
    }
    return found;
}

void sim_iris_past_face(const struct sim_iris *iris, int k, double share[SIM_SAMPLES]) {
    const struct sim_light *light = iris->light;
    const double *alpha = light->alpha + k * SIM_BATCH, *beta = light->beta + k * SIM_BATCH;
    for (int p = 0; p < SIM_SAMPLES; ++p)
        share[p] = light->transfer[p] > 0 ? sim_face_eye_reach(&iris->scene->face, k, alpha[p], beta[p]) : -1;
}

// Breaks of a stretch, in t, where the penumbra of the face's shadow from site k begins and ends.
static void break_at_shadow(const struct sim_iris *iris, int k, struct sim_breaks *breaks) {
    const double *alpha = iris->light->alpha + k * SIM_BATCH, *beta = iris->light->beta + k * SIM_BATCH;
    double share[SIM_SAMPLES];
    sim_iris_past_face(iris, k, share);
    for (int end = 0; end < 2; ++end)
        for (int p = 0; p + 1 < SIM_SAMPLES; ++p) {
            int here = end ? share[p] < 1 : share[p] > 0, next = end ? share[p + 1] < 1 : share[p + 1] > 0;
            if (share[p] < 0 || share[p + 1] < 0 || here == next) continue;
            double low = 0, high = 1, da = alpha[p + 1] - alpha[p], db = beta[p + 1] - beta[p];
            for (int i = 0; i < SIM_SHADOW_STEPS; ++i) {
                double t = (low + high) / 2;
                double there = sim_face_eye_reach(&iris->scene->face, k, alpha[p] + t * da, beta[p] + t * db);
                if ((end ? there < 1 : there > 0) == here) low = t;
                else high = t;
            }
            sim_break_add(breaks, (p + (low + high) / 2) / (SIM_SAMPLES - 1), 0.002);
        }
}

// Of one row: what any site past any lids lights of it, and what all do; where to cut it.
struct cuts {
    double from, to, edge_from, edge_to;
    struct sim_breaks breaks;
};

// Cuts of what a site lights of a row.
static void cut_for(struct sim_iris *iris, int k, const struct stretch *stretch, double u,
                    struct cuts *cuts) {
    const struct sim_scene *scene = iris->scene;
    struct sim_light *light = iris->light;
    double lower[SIM_SAMPLES], upper[SIM_SAMPLES], full_lower[SIM_SAMPLES], full_upper[SIM_SAMPLES], rate;
    const double step = 1.0 / (SIM_SAMPLES - 1);
    struct sim_breaks own = {2, {0, 1}};
    probe_row(iris, k, stretch, u);
    if (!scene->face.eye_clear[k]) break_at_shadow(iris, k, &own);
    for (int l = 0; l < iris->n_lids; ++l) {
        sim_iris_look(&iris->lids[l], light, k, lower, upper, full_lower, full_upper);
        if (sim_most_of_both(lower, upper) < -0.1 * iris->lids[l].softness) continue;
        int last = SIM_SAMPLES - 1;
        cuts->from = fmin(cuts->from, stretch_at(stretch, step * sim_crossing(lower, 0, 1), &rate));
        cuts->to = fmax(cuts->to, stretch_at(stretch, step * sim_crossing(upper, last, -1), &rate));
        double edge_from = step * sim_crossing(full_lower, 0, 1);
        double edge_to = step * sim_crossing(full_upper, last, -1);
        if (!stretch->rises || edge_from > 0)
            cuts->edge_from = fmax(cuts->edge_from, stretch_at(stretch, edge_from, &rate));
        if (!stretch->falls || edge_to < 1)
            cuts->edge_to = fmin(cuts->edge_to, stretch_at(stretch, edge_to, &rate));
        if (iris->n_lids > 2) continue;
        // A site that sets goes behind the far margin once more.
        sim_break_changes(&own, lower, lower, upper, 1, 0, step);
        sim_break_changes(&own, full_lower, lower, upper, 1, 0, step);
        sim_break_changes(&own, upper, lower, upper, -1, 0, step);
        sim_break_changes(&own, full_upper, lower, upper, -1, 0, step);
        if (stretch->rises || stretch->falls) {
            sim_break_add(&own, edge_from, 0.002);
            sim_break_add(&own, edge_to, 0.002);
            sim_break_add(&own, step * sim_crossing(lower, 0, 1), 0.002);
            sim_break_add(&own, step * sim_crossing(upper, last, -1), 0.002);
        }
    }
    for (int i = 1; i + 1 < own.n; ++i) {
        double v = stretch_at(stretch, own.at[i], &rate);
        sim_break_add(&cuts->breaks, v, fmin(0.04, 0.1 * rate));
    }
}

// Gauss's rule on a piece of a stretch.
static void add_piece(struct sim_iris *iris, double u, double weight, const struct stretch *stretch,
                      double from, double to, double want) {
    double t0 = stretch_of(stretch, from), t1 = stretch_of(stretch, to), rate;
    int parts, n = sim_nodes_for(iris->scene->quality.iris * want, &parts);
    const double *rule = iris->scene->rule[n];
    double half = (t1 - t0) / (2 * parts);
    for (int j = 0; j < n * parts; ++j) {
        double v = stretch_at(stretch, t0 + half * (2 * (j / n) + 1 + rule[j % n]), &rate);
        int p = iris->at.n++;
        iris->at.x[p] = u * iris->across[0] + v * iris->up[0];
        iris->at.y[p] = u * iris->across[1] + v * iris->up[1];
        for (int k = 0; k < iris->scene->n_sites; ++k) iris->dark[k][p] = 0;
        for (int i = 0; i < iris->n_unlit; ++i)
            if (iris->unlit[i].from < v && v < iris->unlit[i].to) iris->dark[iris->unlit[i].site][p] = 1;
        iris->at.weight[p] = weight * half * rate * rule[n + j % n];
        if (iris->at.n == SIM_BATCH) sim_iris_flush(iris);
    }
}

void sim_iris_add_row(struct sim_iris *iris, double radius, double u, double weight, double step_mm) {
    const struct sim_scene *scene = iris->scene;
    const struct sim_eye *eye = &scene->eye;
    double chord = sqrt(radius * radius - u * u), edges[SIM_ROW_EDGES];
    struct cuts cuts = {chord, -chord, -chord, chord, {2, {-chord, chord}}};
    struct stretch stretch[SIM_ROW_EDGES + 1];
    int n_edges = 0;
    iris->n_unlit = 0;
    for (int i = 0; i < scene->n_sites; ++i) {
        int k = (int)(iris->light->order[i] - scene->sites), own = 0;
        struct stretch lit = {-chord, 2 * chord, 0, 0};
        if (iris->folds[k]) {
            double v[SIM_EDGE_MOST];
            int found = sim_edge_crossings(iris->edge_of[k], iris->across, u, v);
            for (; own < found && n_edges + own < SIM_ROW_EDGES; ++own) edges[n_edges + own] = v[own];
            int lights = lit_stretch(iris, k, chord, u, edges + n_edges, own, &lit);
            n_edges += own;
            if (!lights) continue;
        }
        cut_for(iris, k, &lit, u, &cuts);
    }
    double from = cuts.from - 0.15, to = cuts.to + 0.15;  // a little more, for what lies between the samples
    if (from >= to) return;
    int n_stretches = cut_row(chord, edges, n_edges, stretch);
    double veiled = eye->limbus - eye->haze, clear2 = veiled * veiled - u * u;
    double clear = clear2 > 0 ? sqrt(clear2) : 0;
    sim_break_add(&cuts.breaks, from, 0.01);
    sim_break_add(&cuts.breaks, to, 0.01);
    sim_break_add(&cuts.breaks, cuts.edge_from, 0.1);
    sim_break_add(&cuts.breaks, cuts.edge_to, 0.1);
    if (clear > 0) {
        sim_break_add(&cuts.breaks, -clear, 0.1);
        sim_break_add(&cuts.breaks, clear, 0.1);
    }
    for (int k = 0; k < n_stretches; ++k) {
        struct sim_breaks breaks = {2, {stretch[k].from, stretch[k].from + stretch[k].length}};
        for (int i = 1; i + 1 < cuts.breaks.n; ++i) sim_break_add(&breaks, cuts.breaks.at[i], 1e-4);
        for (int i = 0; i + 1 < breaks.n; ++i) {
            double at = (breaks.at[i] + breaks.at[i + 1]) / 2, length = breaks.at[i + 1] - breaks.at[i];
            double h = fmin(step_mm, STEP_ROW);
            int rises = i == 0 && stretch[k].rises, falls = i + 2 == breaks.n && stretch[k].falls;
            if (at < from || at > to) continue;
            if (fabs(at) > clear) h = fmin(h, STEP_VEIL * eye->haze);
            if (at < cuts.edge_from || at > cuts.edge_to) h = fmin(h, STEP_EDGE * iris->lids[0].softness);
            double want = NODES_ROW + NODES_EDGE * (rises + falls) + length / h;
            add_piece(iris, u, weight, &stretch[k], breaks.at[i], breaks.at[i + 1], want);
        }
    }
}
