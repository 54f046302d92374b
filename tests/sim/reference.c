// SPDX-License-Identifier: Apache-2.0
//
// The four terms of a response by adaptive cubature (reference_cubature.c) of the model as written
// (reference_world.c): the simulator's judge, slow and independent of it.
//
// face    over (x, y) of the frontal plane
// sclera  over polar angle and azimuth of the eye's own frame, from the limbus to its back
// iris    from one end: rays through the cornea by Snell's law, over the part of the cornea through which
// that end
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

struct scene {
    const struct world *worlds;  // one per state; eye and lids differ
    int n_worlds, n_ports, n_pairs;
    struct ref_port ports[MAX_PORTS];  // sensors, then emitters
    int first[MAX_PORTS];              // the first port at the same place with the same lens
    int pair[MAX_PAIRS][2];            // port numbers
};

#include "reference_surfaces.c"
#include "reference_iris.c"
#include "reference_glint.c"

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
                if (profile(w, mid, &slope) * sin(mid) > edge)
                    to = mid;
                else
                    from = mid;
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
            *iris = (struct iris){
                .scene = scene, .w = w, .seen = seen, .from = k, .all_paths = (terms & 16) != 0};
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
            const struct ref_port *a = &scene->ports[scene->pair[i][0]],
                                  *b = &scene->ports[scene->pair[i][1]];
            job->context.glint = (struct glint){.w = w, .port = {a, b}, .alpha2 = lobe_alpha2(w, a, b)};
            search_lobe(&job->cubature, &job->context.glint, 0, THETA_END, 0, 2 * PI);
        }
    }
    return 0;
}

int ref_evaluate(const struct ref_person *person, const struct ref_port *sensors, int n_sensors,
                 const struct ref_port *emitters, int n_emitters, const int *pairs, const int *counts,
                 int n_pairs, const double *states, int n_states, int terms, double tol, double scale,
                 double *value, double *error, long *points) {
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
            while (
                memcmp(scene->ports[f].position, scene->ports[k].position, sizeof scene->ports[k].position) ||
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
            for (int i = 0; i < job->n; ++i)
                value[job->slot[i]] = job->value[i], error[job->slot[i]] = job->error[i];
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
