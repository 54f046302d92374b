// SPDX-License-Identifier: Apache-2.0
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sim_inside.h"

#define PI 3.14159265358979323846
static const double LEAST_SIGMA_DEG = 0.5, FARTHEST_MM = 1e4, WILDEST = 1e4;
// What sim_opening.c resolves: a spot of light's standard deviation, the width of the margins' edge.
static const double LEAST_SPOT_MM = 0.2, LEAST_SOFTNESS_MM = 0.2;

struct sim_quality sim_quality_default(void) {
    struct sim_quality q = {.sclera = 1, .iris = 1, .glint = 1, .face = 1, .tolerance = 0};
    return q;
}

// Gauss-Legendre nodes and weights on -1..1, by Newton on the Legendre recurrence.
static void gauss_legendre(int n, double *x) {
    for (int i = 0; i < n; ++i) {
        double z = cos(PI * (i + 0.75) / (n + 0.5)), slope = 1;
        for (int k = 0; k < 50; ++k) {
            double p0 = 1, p1 = z;
            for (int j = 2; j <= n; ++j) {
                double p2 = ((2 * j - 1) * z * p1 - (j - 1) * p0) / j;
                p0 = p1;
                p1 = p2;
            }
            slope = n * (z * p1 - p0) / (z * z - 1);
            double step = p1 / slope;
            z -= step;
            if (fabs(step) < 1e-15) break;
        }
        x[i] = z;
        x[n + i] = 2 / ((1 - z * z) * slope * slope);
    }
}

static int refuse(char *error, size_t bytes, const char *why) {
    if (error && bytes) snprintf(error, bytes, "%s", why);
    return -1;
}

static int check_person(const struct sim_person *p, char *error, size_t bytes) {
    double number[sizeof *p / sizeof(double)];
    memcpy(number, p, sizeof number);
    for (size_t i = 0; i < sizeof number / sizeof *number; ++i)
        if (!isfinite(number[i])) return refuse(error, bytes, "a number of the person is not finite");
    for (size_t i = 0; i < sizeof number / sizeof *number; ++i)
        if (fabs(number[i]) > WILDEST)
            return refuse(error, bytes, "a number of the person is beyond all anatomy");
    if (fabs(p->kappa_azimuth_deg) > 45 || fabs(p->kappa_elevation_deg) > 45)
        return refuse(error, bytes, "kappa is beyond 45 degrees");
    if (fabs(p->brow_mm) > 60 || fabs(p->nose_mm) > 60 || fabs(p->cheek_mm) > 60)
        return refuse(error, bytes, "brow, nose or cheek is beyond 60 mm");
    if (fabs(p->lid_upper_follow) > 3 || fabs(p->lid_lower_follow) > 3 || fabs(p->canthus_tilt_deg) > 45)
        return refuse(error, bytes, "the lids' motion or tilt is impossible");
    double curve = p->cornea_radius_mm * p->cornea_radius_mm -
                   (1 + p->cornea_asphericity) * p->limbus_radius_mm * p->limbus_radius_mm;
    if (!(p->cornea_radius_mm > 0 && p->globe_radius_mm > p->limbus_radius_mm && p->limbus_radius_mm > 0 &&
          curve > 0))
        return refuse(error, bytes, "cornea and globe do not meet: check cornea, limbus and globe radii");
    if (!(p->limbus_blend_mm > 0 && p->limbus_haze_mm > 0))
        return refuse(error, bytes, "the limbus needs a width");
    if (!(p->refractive_index > 1 && p->refractive_index < 2))
        return refuse(error, bytes, "refractive index not in 1..2");
    if (!(p->roughness > 0 && p->roughness < 1)) return refuse(error, bytes, "roughness not in 0..1");
    double albedo[3] = {p->albedo_sclera, p->albedo_iris, p->albedo_skin};
    for (int i = 0; i < 3; ++i)
        if (!(albedo[i] >= 0 && albedo[i] <= 1)) return refuse(error, bytes, "an albedo is not in 0..1");
    double sag = p->limbus_radius_mm * p->limbus_radius_mm / (p->cornea_radius_mm + sqrt(curve));
    if (!(p->iris_depth_mm > sag && p->iris_depth_mm < p->globe_radius_mm))
        return refuse(error, bytes, "the iris is not behind the limbus");
    if (!(p->canthus_deg > 10 && p->canthus_deg < 85 && p->lid_upper_deg > p->lid_lower_deg &&
          p->lid_close_at >= 0 && p->lid_close_at <= 1 && p->lid_thickness_mm >= 0 &&
          p->lid_softness_mm > 0 && fabs(p->lid_upper_deg) < 60 && fabs(p->lid_lower_deg) < 60))
        return refuse(error, bytes, "the lids' shape is impossible");
    if (!(p->lid_softness_mm >= LEAST_SOFTNESS_MM))
        return refuse(error, bytes, "the lids' softness is below 0.2 mm");
    if (!(p->lash_length_mm >= 0 && p->lash_length_mm <= 15 && p->lash_opacity >= 0 && p->lash_opacity <= 1))
        return refuse(error, bytes, "lashes are 0..15 mm long and of opacity 0..1");
    if (!(p->lid_radius_mm > p->globe_radius_mm))
        return refuse(error, bytes, "the lids lie inside the globe");
    return 0;
}

// Whether the edge of a lens (a disc across its aim) reaches into the eye or the face.
static int touches(const struct sim_scene *scene, const double at[3], const struct sim_port *port) {
    double size = sqrt(sim_dot(port->aim, port->aim)), a[3], u[3], v[3];
    for (int k = 0; k < 3; ++k) a[k] = port->aim[k] / size;
    int least = fabs(a[0]) < fabs(a[1]) ? 0 : 1;
    for (int k = 0; k < 3; ++k) u[k] = (k == least) - a[least] * a[k];
    size = sqrt(sim_dot(u, u));
    for (int k = 0; k < 3; ++k) u[k] /= size;
    for (int k = 0; k < 3; ++k) v[k] = a[(k + 1) % 3] * u[(k + 2) % 3] - a[(k + 2) % 3] * u[(k + 1) % 3];
    for (int i = 0; i < 16; ++i) {
        double c = port->radius_mm * cos(i * PI / 8), s = port->radius_mm * sin(i * PI / 8), rim[3];
        for (int k = 0; k < 3; ++k) rim[k] = at[k] + c * u[k] + s * v[k];
        if (sim_dot(rim, rim) < scene->eye.apex * scene->eye.apex) return 1;
        if (-rim[2] < sim_face_height(&scene->person, rim[0], rim[1])) return 1;
    }
    return 0;
}

// How far from a place its axis meets the face with closed lids or the eye, mm; INFINITY: nowhere.
static double first_hit(const struct sim_scene *scene, const double at[3], const double aim[3]) {
    const double highest = 200, step = 0.1;  // of the face, mm
    double size = sqrt(sim_dot(aim, aim)), from = 0, d[3];
    for (int k = 0; k < 3; ++k) d[k] = aim[k] / size;
    if (-at[2] > highest) {
        if (d[2] <= 0) return INFINITY;
        from = (-at[2] - highest) / d[2];
    }
    for (double t = from; t < from + 4 * highest; t += step) {
        double p[3] = {at[0] + t * d[0], at[1] + t * d[1], at[2] + t * d[2]};
        if (sim_dot(p, p) < scene->eye.apex * scene->eye.apex) return t;
        if (p[0] < SIM_SKIN_X_FROM || p[0] > SIM_SKIN_X_TO || p[1] < SIM_SKIN_Y_FROM || p[1] > SIM_SKIN_Y_TO)
            continue;
        if (-p[2] <= sim_face_height(&scene->person, p[0], p[1])) return t;
    }
    return INFINITY;
}

static int check_port(const struct sim_scene *scene, const double at[3], const struct sim_port *port,
                      const char *what, int number, char *error, size_t bytes) {
    const struct sim_person *p = &scene->person;
    char text[160];
    const char *why = NULL;
    double size = sqrt(sim_dot(port->aim, port->aim)), distance = sqrt(sim_dot(at, at)),
           nearest = scene->eye.apex;
    if (!(isfinite(size) && isfinite(distance) && isfinite(port->sigma_deg) && isfinite(port->radius_mm)))
        why = "has a number that is not finite";
    else if (!(size > 0)) why = "has no aim";
    else if (!(port->sigma_deg >= LEAST_SIGMA_DEG && port->sigma_deg <= 85))
        why = "has an angular sigma outside 0.5..85 degrees";
    else if (distance > FARTHEST_MM) why = "is more than 10 m away";
    else if (distance < nearest + 0.2) why = "is inside the eyeball or touches it at some gaze";
    else if (-at[2] < sim_face_height(p, at[0], at[1]) + 0.2) why = "is inside or behind the face";
    else if (!(port->radius_mm >= 0)) why = "has a lens of negative radius";
    else if (!(port->radius_mm < distance / 4))
        why = "has a lens too large for its distance (a quarter of it)";
    else if (touches(scene, at, port)) why = "has a lens that reaches into the eye or the face";
    else if (first_hit(scene, at, port->aim) * tan(port->sigma_deg * SIM_RADIANS) < LEAST_SPOT_MM)
        why = "has a spot of light narrower than 0.2 mm where it meets the face or the eye";
    if (!why) return 0;
    snprintf(text, sizeof text, "%s %d %s", what, number, why);
    return refuse(error, bytes, text);
}

static int add_ports(struct sim_scene *scene, const struct sim_port *ports, int n, const double slip[3],
                     const char *what, struct sim_window *windows, char *error, size_t bytes) {
    for (int i = 0; i < n; ++i) {
        double at[3], size = sqrt(sim_dot(ports[i].aim, ports[i].aim)),
                      t = tan(ports[i].sigma_deg * SIM_RADIANS);
        for (int k = 0; k < 3; ++k)
            at[k] = ports[i].position_mm[k] + slip[k] - scene->person.eye_position_mm[k];
        if (check_port(scene, at, &ports[i], what, i, error, bytes)) return -1;
        int site = 0;
        for (; site < scene->n_sites; ++site) {
            const struct sim_site *s = &scene->sites[site];
            if (!memcmp(s->position, at, sizeof at) && s->radius == ports[i].radius_mm) break;
        }
        if (site == scene->n_sites) {
            memcpy(scene->sites[site].position, at, sizeof at);
            scene->sites[site].radius = ports[i].radius_mm;
            ++scene->n_sites;
        }
        windows[i].site = site;
        windows[i].per_tan2 = 1 / (2 * t * t);
        for (int k = 0; k < 3; ++k) windows[i].aim[k] = ports[i].aim[k] / size;
    }
    return 0;
}

static int prepare(struct sim_scene *scene, char *error, size_t bytes) {
    const struct sim_quality *q = &scene->quality;
    const double fineness[4] = {q->sclera, q->iris, q->glint, q->face};
    for (int i = 0; i < 4; ++i)
        if (!(fineness[i] >= 0.1 && fineness[i] <= 16))
            return refuse(error, bytes, "quality out of range 0.1..16");
    if (!(q->tolerance >= 0 && q->tolerance < 1)) return refuse(error, bytes, "tolerance out of range");
    int total = SIM_MAX_RULE * (SIM_MAX_RULE + 1);
    if (!(scene->nodes = malloc((size_t)total * sizeof(double))))
        return refuse(error, bytes, "out of memory");
    double *at = scene->nodes;
    for (int n = 1; n <= SIM_MAX_RULE; at += 2 * n++) {
        gauss_legendre(n, at);
        scene->rule[n] = at;
    }
    sim_profile_init(&scene->profile, &scene->eye);
    double sites[2 * SIM_MAX_PORTS][3], radius[2 * SIM_MAX_PORTS];
    for (int k = 0; k < scene->n_sites; ++k) {
        memcpy(sites[k], scene->sites[k].position, sizeof sites[k]);
        radius[k] = scene->sites[k].radius;
    }
    if (sim_face_open(&scene->face, &scene->person, (const double (*)[3])sites, radius, scene->n_sites) ||
        sim_prepare_face(scene))
        return refuse(error, bytes, "out of memory");
    return 0;
}

struct sim_scene *sim_scene_open(const struct sim_person *person, const struct sim_port *sensors,
                                 int n_sensors, const struct sim_port *emitters, int n_emitters,
                                 const double *slip_mm, const struct sim_quality *quality, char *error,
                                 size_t error_bytes) {
    const double still[3] = {0, 0, 0}, *slip = slip_mm ? slip_mm : still;
    if (n_sensors < 1 || n_sensors > SIM_MAX_PORTS || n_emitters < 1 || n_emitters > SIM_MAX_PORTS) {
        refuse(error, error_bytes, "number of sensors or emitters out of range");
        return NULL;
    }
    if (check_person(person, error, error_bytes)) return NULL;
    struct sim_scene *scene = calloc(1, sizeof *scene);
    if (!scene) {
        refuse(error, error_bytes, "out of memory");
        return NULL;
    }
    scene->person = *person;
    scene->quality = quality ? *quality : sim_quality_default();
    scene->n_sensors = n_sensors;
    scene->n_emitters = n_emitters;
    sim_eye_init(&scene->eye, person);
    if (add_ports(scene, sensors, n_sensors, slip, "sensor", scene->sensors, error, error_bytes) ||
        add_ports(scene, emitters, n_emitters, slip, "emitter", scene->emitters, error, error_bytes) ||
        prepare(scene, error, error_bytes)) {
        sim_scene_close(scene);
        return NULL;
    }
    return scene;
}

static int site_of(const struct sim_scene *scene, int emitter, int number) {
    if (number < 0 || number >= (emitter ? scene->n_emitters : scene->n_sensors)) return -1;
    return emitter ? scene->emitters[number].site : scene->sensors[number].site;
}

int sim_scene_port_facts(const struct sim_scene *scene, int emitter, int number,
                         struct sim_port_facts *facts) {
    int site = site_of(scene, emitter, number);
    if (site < 0) return -1;
    facts->eye_clear = scene->face.eye_clear[site];
    facts->skin_clear = !scene->skin_facts.penumbra[site];
    facts->widened_mm = scene->face.lens[site] > scene->sites[site].radius ? scene->face.lens[site] : 0;
    return 0;
}

double sim_scene_eye_reach(const struct sim_scene *scene, int emitter, int number, double alpha_deg,
                           double beta_deg) {
    int site = site_of(scene, emitter, number);
    if (site < 0 || !(fabs(alpha_deg) <= 90 && fabs(beta_deg) <= 90)) return NAN;
    return sim_face_eye_reach(&scene->face, site, alpha_deg * SIM_RADIANS, beta_deg * SIM_RADIANS);
}

void sim_scene_face_facts(const struct sim_scene *scene, struct sim_face_facts *facts) {
    facts->panel_spots = scene->skin_facts.spots;
    facts->panel_tolerance = scene->skin_facts.tolerance;
    facts->panel_goal = scene->skin_facts.goal;
    facts->lid_spots = scene->skin_facts.lid_spots;
    facts->lid_step_mm = scene->skin_facts.lid_step_mm;
}

void sim_scene_close(struct sim_scene *scene) {
    if (!scene) return;
    sim_face_close(&scene->face);
    free(scene->nodes);
    free(scene->face_all);
    free(scene->face_spots);
    free(scene->lid_spots);
    free(scene->lid_columns);
    free(scene);
}

double sim_person_face_mm(const struct sim_person *person, double x_mm, double y_mm) {
    return sim_face_height(person, x_mm, y_mm);
}

double sim_person_horizon_mm(const struct sim_person *person, const double from_mm[3], const double to_mm[3],
                             int relief_only) {
    struct sim_relief relief;
    double slope[2], zero = INFINITY;
    sim_relief_init(&relief, person);
    if (!relief_only) {
        sim_relief_slope(&relief, from_mm[0], from_mm[1], slope);
        zero = sim_relief_tangent(from_mm, slope, to_mm);
    }
    return sim_relief_horizon(&relief, relief_only ? SIM_PART_RELIEF : SIM_PART_ALL, from_mm, to_mm, zero,
                              INFINITY);
}

double sim_person_skin_share(const struct sim_person *person, double x_mm, double y_mm, const double to_mm[3],
                             double lens_radius_mm) {
    struct sim_relief relief;
    double skin[3] = {x_mm, y_mm, 0}, slope[2];
    sim_relief_init(&relief, person);
    skin[2] = -sim_relief_slope(&relief, x_mm, y_mm, slope);
    return sim_relief_share(&relief, skin, slope, to_mm, fmax(lens_radius_mm, SIM_LEAST_LENS_MM));
}

double sim_person_profile_mm(const struct sim_person *person, double angle_deg) {
    struct sim_eye eye;
    double derivative;
    sim_eye_init(&eye, person);
    return sim_eye_rho(&eye, sin(angle_deg * SIM_RADIANS), cos(angle_deg * SIM_RADIANS), &derivative);
}

double sim_person_iris_light(const struct sim_person *person, const double site_mm[3],
                             const double spot_mm[3], double exit_mm[3]) {
    struct sim_eye eye;
    sim_eye_init(&eye, person);
    return sim_eye_refract(&eye, site_mm, spot_mm, exit_mm);
}
