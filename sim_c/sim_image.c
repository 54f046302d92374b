// SPDX-License-Identifier: Apache-2.0
#include "sim_image.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sim_image_face.h"
#include "sim_inside.h"

#define PI 3.14159265358979323846
enum { MAX_LAYERS = 8 };  // surfaces behind each other that one ray may meet

// Skin in one pixel: what the lids' pose does not change.
struct skin {
    int pixel, lid;  // lid: an open eye may take its place
    double alpha, beta, rho;
};

struct sim_image {
    const struct sim_scene *scene;
    struct sim_camera camera;
    int n_emitters, occlusion;
    int emitters[SIM_MAX_PORTS];
    struct sim_image_face *closed, *relief;  // kept where rays decide
    struct skin *skin;
    double *skin_light;  // [n_skin][n_emitters] radiance with the lids closed
    int n_skin, room;
};

static int refuse(char *error, size_t bytes, const char *why) {
    if (error && bytes) snprintf(error, bytes, "%s", why);
    return -1;
}

int sim_camera_set(struct sim_camera *camera, const struct sim_scene *scene, int sensor, const int *emitters,
                   int n_emitters, int pixels, double half_width_sigmas, char *error, size_t bytes) {
    if (sensor < 0 || sensor >= scene->n_sensors) return refuse(error, bytes, "no such sensor");
    if (n_emitters < 1 || n_emitters > SIM_MAX_PORTS) return refuse(error, bytes, "no emitters");
    for (int e = 0; e < n_emitters; ++e)
        if (emitters[e] < 0 || emitters[e] >= scene->n_emitters)
            return refuse(error, bytes, "no such emitter");
    if (pixels < 2 || pixels > SIM_IMAGE_MAX_PIXELS) return refuse(error, bytes, "pixels not in 2..4096");
    if (!(half_width_sigmas > 0 && half_width_sigmas <= 100))
        return refuse(error, bytes, "half width not in 0..100 sigmas");
    const struct sim_window *window = &scene->sensors[sensor];
    camera->site = window->site;
    camera->per_tan2 = window->per_tan2;
    camera->pixels = pixels;
    camera->half = half_width_sigmas / sqrt(2 * window->per_tan2);
    camera->pitch = 2 * camera->half / pixels;
    memcpy(camera->position, scene->sites[window->site].position, sizeof camera->position);
    memcpy(camera->aim, window->aim, sizeof camera->aim);
    // right = aim x up; who looks straight up or down holds the camera's top forward.
    const double *a = camera->aim, top[2][3] = {{0, 1, 0}, {0, 0, -1}}, *u = top[fabs(a[1]) > 0.999];
    double right[3] = {a[1] * u[2] - a[2] * u[1], a[2] * u[0] - a[0] * u[2], a[0] * u[1] - a[1] * u[0]};
    double size = sqrt(sim_dot(right, right));
    for (int k = 0; k < 3; ++k) camera->right[k] = right[k] / size;
    const double *r = camera->right;
    camera->up[0] = r[1] * a[2] - r[2] * a[1];
    camera->up[1] = r[2] * a[0] - r[0] * a[2];
    camera->up[2] = r[0] * a[1] - r[1] * a[0];
    return 0;
}

static void pixel_ray(const struct sim_camera *camera, int pixel, double ray[3]) {
    int row = pixel / camera->pixels, column = pixel % camera->pixels;
    double x = (column + 0.5) * camera->pitch - camera->half,
           y = camera->half - (row + 0.5) * camera->pitch;
    double cosine = 1 / sqrt(1 + x * x + y * y);
    for (int k = 0; k < 3; ++k)
        ray[k] = cosine * (camera->aim[k] + x * camera->right[k] + y * camera->up[k]);
}

static int open_faces(struct sim_image *image, char *error, size_t bytes) {
    const struct sim_person *person = &image->scene->person;
    image->closed = sim_image_face_open(person, 0, error, bytes);
    if (image->closed && image->occlusion == SIM_OCCLUSION_RAYS)
        image->relief = sim_image_face_open(person, 1, error, bytes);
    return image->closed && (image->relief || image->occlusion != SIM_OCCLUSION_RAYS) ? 0 : -1;
}

static int add_skin(struct sim_image *image, int pixel, const struct sim_image_hit *hit) {
    const struct sim_scene *scene = image->scene;
    if (image->n_skin == image->room) {
        int room = image->room ? 2 * image->room : 4096;
        struct skin *skin = realloc(image->skin, (size_t)room * sizeof *skin);
        if (skin) image->skin = skin;
        double *light =
            realloc(image->skin_light, (size_t)room * (size_t)image->n_emitters * sizeof *light);
        if (light) image->skin_light = light;
        if (!skin || !light) return -1;
        image->room = room;
    }
    struct skin *s = &image->skin[image->n_skin];
    double *light = image->skin_light + (size_t)image->n_skin * (size_t)image->n_emitters;
    struct sim_lid_point at;
    int soft = image->occlusion == SIM_OCCLUSION_SOFT, any = 0;
    const struct sim_site *eye = &scene->sites[image->camera.site];
    double seen = soft ? sim_image_face_share(image->closed, hit, eye->position, eye->radius) : 1;
    s->pixel = pixel;
    s->rho = sim_lid_locate(hit->point, &at, &s->alpha, &s->beta);
    s->lid = fabs(s->alpha) < (scene->person.canthus_deg + 4) * SIM_RADIANS &&
             fabs(s->beta) < 65 * SIM_RADIANS && -hit->point[2] > 1;
    for (int e = 0; e < image->n_emitters; ++e) {
        const struct sim_window *beam = &scene->emitters[image->emitters[e]];
        const struct sim_site *site = &scene->sites[beam->site];
        double away[3], distance;
        double t = sim_surface_transfer(site, hit->point, hit->normal, away, &distance);
        if (t > 0) t *= seen * sim_window_weight(beam, away);
        if (t > 0 && soft)
            t *= sim_image_face_share(image->closed, hit, site->position, site->radius);
        else if (t > 0) {
            double off[3];
            for (int k = 0; k < 3; ++k) off[k] = hit->point[k] + 0.02 * hit->normal[k];
            if (sim_image_face_blocked(image->closed, off, site->position)) t = 0;
        }
        light[e] = t * scene->person.albedo_skin / PI;
        any |= t > 0;
    }
    image->n_skin += any;
    return 0;
}

struct sim_image *sim_image_open(const struct sim_scene *scene, int sensor, const int *emitters,
                                 int n_emitters, int pixels, double half_width_sigmas, int occlusion,
                                 char *error, size_t error_bytes) {
    struct sim_camera camera;
    if (sim_camera_set(&camera, scene, sensor, emitters, n_emitters, pixels, half_width_sigmas, error,
                       error_bytes))
        return NULL;
    struct sim_image *image = calloc(1, sizeof *image);
    if (!image) {
        refuse(error, error_bytes, "out of memory");
        return NULL;
    }
    image->scene = scene;
    image->camera = camera;
    image->n_emitters = n_emitters;
    image->occlusion = occlusion;
    memcpy(image->emitters, emitters, (size_t)n_emitters * sizeof *emitters);
    if (open_faces(image, error, error_bytes)) {
        sim_image_close(image);
        return NULL;
    }
    for (int i = 0; i < pixels * pixels; ++i) {
        double ray[3], from = 0;
        struct sim_image_hit hit;
        pixel_ray(&camera, i, ray);
        for (int layer = 0; layer < (occlusion == SIM_OCCLUSION_SOFT ? MAX_LAYERS : 1); ++layer) {
            if (!sim_image_face_hit(image->closed, camera.position, ray, from, &hit)) break;
            if (add_skin(image, i, &hit)) {
                refuse(error, error_bytes, "out of memory");
                sim_image_close(image);
                return NULL;
            }
            from = hit.beyond;
        }
    }
    return image;
}

void sim_image_close(struct sim_image *image) {
    if (!image) return;
    sim_image_face_close(image->closed);
    sim_image_face_close(image->relief);
    free(image->skin);
    free(image->skin_light);
    free(image);
}

double sim_image_widen(const struct sim_scene *scene, const double axes[9], int site) {
    const struct sim_eye *eye = &scene->eye;
    double d[3], centre = eye->apex - eye->radius;
    for (int k = 0; k < 3; ++k) d[k] = scene->sites[site].position[k] - centre * axes[3 * k + 2];
    double half = scene->sites[site].radius / (2 * (sqrt(sim_dot(d, d)) - 0.9 * eye->radius));
    return half * half / 2;
}

int sim_image_bad_state(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                        double pupil_mm, double lid_opening) {
    return !(fabs(azimuth_deg) <= 60 && fabs(elevation_deg) <= 60 && pupil_mm > 0 &&
             pupil_mm < 2 * scene->eye.limbus && lid_opening >= 0 && lid_opening <= 1);
}

// The eye -----------------------------------------------------------------------------------------------------

struct look {
    const struct sim_image *image;
    double axes[9], camera_eye[3], sites_eye[2 * SIM_MAX_PORTS][3];  // eye frame
    double pupil_radius, widen[2 * SIM_MAX_PORTS];
    struct sim_lid lid;
    int terms, pixel;
    double *radiance;
};

static void to_eye(const double axes[9], const double head[3], double eye[3]) {
    for (int j = 0; j < 3; ++j) eye[j] = axes[j] * head[0] + axes[3 + j] * head[1] + axes[6 + j] * head[2];
}

static void to_head(const double axes[9], const double eye[3], double head[3]) {
    for (int i = 0; i < 3; ++i)
        head[i] = axes[3 * i] * eye[0] + axes[3 * i + 1] * eye[1] + axes[3 * i + 2] * eye[2];
}

// Distance from the centre less the surface's there, at a place on a ray; its slope along the ray.
static double outside(const struct sim_eye *eye, const double from[3], const double ray[3], double t,
                      double point[3], double normal[3]) {
    for (int k = 0; k < 3; ++k) point[k] = from[k] + t * ray[k];
    double flat = sqrt(point[0] * point[0] + point[1] * point[1]), r = sqrt(flat * flat + point[2] * point[2]);
    double s = flat / r, c = point[2] / r, slope, rho = sim_eye_rho(eye, s, c, &slope);
    if (normal) {
        double cut = flat > 1e-12 ? slope / rho / flat : 0, n[3], size;
        // e_r - (rho' / rho) e_theta, e_theta = (c x / flat, c y / flat, -s)
        n[0] = point[0] / r - cut * c * point[0];
        n[1] = point[1] / r - cut * c * point[1];
        n[2] = c + slope / rho * s;
        size = sqrt(sim_dot(n, n));
        for (int k = 0; k < 3; ++k) normal[k] = n[k] / size;
    }
    return r - rho;
}

// The next place beyond *t where a ray enters the eye. Steps are shorter than the way to the surface can be
// (its slope against the sphere is below 40 degrees), but 2e-3 mm at least: what lies between is a grazing
// chord of no depth.
static int enter_eye(const struct sim_eye *eye, const double from[3], const double ray[3], double *t,
                     double point[3], double normal[3]) {
    double reach = eye->apex + eye->blend, along = -sim_dot(from, ray), foot[3];
    for (int k = 0; k < 3; ++k) foot[k] = from[k] + along * ray[k];
    double room = reach * reach - sim_dot(foot, foot);
    if (room <= 0) return 0;
    double end = along + sqrt(room), at = along - sqrt(room), before = at;
    if (*t > at) before = at = *t;
    double gap = outside(eye, from, ray, at, point, NULL), last = gap;
    int was_inside = gap <= 0;
    while (at < end) {
        double step = fabs(gap) / 1.3;
        before = at;
        last = gap;
        at += step > 2e-3 ? step : 2e-3;
        gap = outside(eye, from, ray, at, point, NULL);
        if (!was_inside && gap <= 0) break;
        was_inside = gap <= 0;
    }
    if (at >= end) return 0;
    for (int i = 0; i < 60; ++i) {  // regula falsi (Illinois)
        *t = before + (at - before) * last / (last - gap);
        double g = outside(eye, from, ray, *t, point, NULL);
        if (fabs(g) < 1e-13 || at - before < 1e-13 * at) break;
        if (g <= 0) {
            at = *t, gap = g, last /= 2;
        } else {
            before = *t, last = g, gap /= 2;
        }
    }
    outside(eye, from, ray, *t, point, normal);
    return 1;
}

// One end of the light's way at a place of the eye: the unit vector to a site, its distance, and what lids and
// face let through. Head frame.
struct end {
    double away[3], distance, open;
};

static void look_at(const struct look *look, const double head[3], int site, int by_rays, struct end *end) {
    const struct sim_scene *scene = look->image->scene;
    const double *to = scene->sites[site].position;
    double d[3] = {to[0] - head[0], to[1] - head[1], to[2] - head[2]}, alpha, beta;
    struct sim_lid_point at;
    end->distance = sqrt(sim_dot(d, d));
    for (int k = 0; k < 3; ++k) end->away[k] = d[k] / end->distance;
    double rho = sim_lid_locate(head, &at, &alpha, &beta);
    sim_lid_measure(&look->lid, alpha, beta, rho, &at);
    end->open = sim_lid_open_toward(&look->lid, &at, end->away);
    if (end->open == 0) return;
    if (!by_rays) {
        end->open *= sim_face_eye_reach(&scene->face, site, alpha, beta);
        return;
    }
    double off[3], big = scene->person.lid_radius_mm + 0.02;
    for (int k = 0; k < 3; ++k) off[k] = big * at.radial[k];
    if (sim_image_face_blocked(look->image->relief, off, to)) end->open = 0;
}

// Part of a lens that a place of the globe sees past the cornea's sphere.
static double past_bulge(const struct look *look, const double head[3], const struct end *end, int site) {
    const struct sim_eye *eye = &look->image->scene->eye;
    double c[3], centre = eye->apex - eye->radius;
    for (int k = 0; k < 3; ++k) c[k] = centre * look->axes[3 * k + 2] - head[k];
    double along = sim_dot(c, end->away);
    if (along <= 0) return 1;
    double miss2 = sim_dot(c, c) - along * along, miss = sqrt(miss2 > 0 ? miss2 : 0) - eye->radius;
    double spread = (look->image->scene->sites[site].radius + 0.3) * along / end->distance;
    return sim_step(0.5 + miss / (2 * spread + 1e-9));
}

// Whether the eye itself stands between a place on it and a site.
static int eye_between(const struct look *look, const double point[3], const double normal[3], int site) {
    double to[3], off[3], p[3], n[3], t = 0;
    for (int k = 0; k < 3; ++k) off[k] = point[k] + 1e-4 * normal[k];
    for (int k = 0; k < 3; ++k) to[k] = look->sites_eye[site][k] - off[k];
    double size = sqrt(sim_dot(to, to));
    for (int k = 0; k < 3; ++k) to[k] /= size;
    return enter_eye(&look->image->scene->eye, off, to, &t, p, n) && t < size;
}

static double beam_of(const struct look *look, int e, const double away[3]) {
    return sim_window_weight(&look->image->scene->emitters[look->image->emitters[e]], away);
}

enum { FACE, SCLERA, IRIS, GLINT };

static void add_light(const struct look *look, int part, int e, double light) {
    size_t n = (size_t)look->image->camera.pixels, plane = (size_t)e;
    if (look->terms & SIM_IMAGE_APART) plane += (size_t)(part * look->image->n_emitters);
    look->radiance[plane * n * n + (size_t)look->pixel] += light;
}

// Sclera and glint where a ray enters the eye.
static void add_surface(const struct look *look, const double point[3], const double normal[3]) {
    const struct sim_image *image = look->image;
    const struct sim_scene *scene = image->scene;
    int by_rays = image->occlusion == SIM_OCCLUSION_RAYS, own = image->camera.site;
    double head[3], up[3], r = sqrt(point[0] * point[0] + point[1] * point[1]);
    to_head(look->axes, point, head);
    to_head(look->axes, normal, up);
    struct end view, lamp;
    look_at(look, head, own, by_rays, &view);
    double facing = sim_dot(view.away, up);
    if (view.open == 0 || facing <= 0) return;
    double white = point[2] > 0 ? sim_eye_whiteness(&scene->eye, r) : 1, seen = 0;
    if (white > 0 && look->terms & SIM_TERM_SCLERA)
        seen = by_rays ? view.open : view.open * past_bulge(look, head, &view, own);
    for (int e = 0; e < image->n_emitters; ++e) {
        int site = scene->emitters[image->emitters[e]].site;
        const struct sim_site *at = &scene->sites[site];
        double away[3], distance, lit = sim_surface_transfer(at, head, up, away, &distance);
        if (lit <= 0) continue;
        look_at(look, head, site, by_rays, &lamp);
        double beam = lamp.open * beam_of(look, e, away);
        if (beam == 0 || (by_rays && eye_between(look, point, normal, site))) continue;
        if (seen > 0) {
            double bulge = by_rays ? 1 : past_bulge(look, head, &lamp, site);
            add_light(look, SCLERA, e, scene->person.albedo_sclera / PI * white * seen * lit * beam * bulge);
        }
        if (!(look->terms & SIM_IMAGE_GLINT) || sim_dot(up, away) <= 0) continue;
        double h[3];
        for (int k = 0; k < 3; ++k) h[k] = away[k] + view.away[k];
        double size = sqrt(sim_dot(h, h)), c = sim_dot(up, h) / size, c2 = c * c;
        double rough = scene->person.roughness;
        double alpha2 = rough * rough + look->widen[own] + look->widen[site];
        double slope2 = (1 - c2) / (c2 * alpha2);
        if (c < 0.1 || slope2 > 30) continue;
        double lobe = exp(-slope2) / (PI * alpha2 * c2 * c2);
        double mirrored = lobe * sim_fresnel(scene->eye.index, sim_dot(away, h) / size) / (4 * facing);
        add_light(look, GLINT, e, mirrored * view.open * beam / (distance * distance));
    }
}

// The iris, where a ray through the cornea meets it.
static void add_iris(const struct look *look, const double ray[3]) {
    const struct sim_image *image = look->image;
    const struct sim_scene *scene = image->scene;
    const struct sim_eye *eye = &scene->eye;
    int by_rays = image->occlusion == SIM_OCCLUSION_RAYS;
    // The conic, from the ray's place nearest to the centre, so that large distances do not cancel.
    double along = -sim_dot(look->camera_eye, ray), foot[3], q[3], inside[3], spot[3];
    for (int k = 0; k < 3; ++k) foot[k] = look->camera_eye[k] + along * ray[k];
    double s = eye->apex - foot[2], a = ray[0] * ray[0] + ray[1] * ray[1] + eye->p * ray[2] * ray[2];
    double b = foot[0] * ray[0] + foot[1] * ray[1] + eye->radius * ray[2] - eye->p * s * ray[2];
    double c = foot[0] * foot[0] + foot[1] * foot[1] - 2 * eye->radius * s + eye->p * s * s;
    double disc = b * b - a * c;
    if (disc <= 0) return;
    double t = b < 0 ? c / (sqrt(disc) - b) : -(b + sqrt(disc)) / a;
    for (int k = 0; k < 3; ++k) q[k] = foot[k] + t * ray[k];
    double r2 = q[0] * q[0] + q[1] * q[1], root2 = eye->radius * eye->radius - eye->p * r2;
    if (root2 <= 0 || eye->apex - q[2] > eye->radius) return;
    double root = sqrt(root2), size = sqrt(r2 + root2), n[3] = {q[0] / size, q[1] / size, root / size};
    double clear = 1 - sim_eye_whiteness(eye, sqrt(r2)), cosine = -sim_dot(ray, n), index = eye->index;
    if (clear <= 0 || cosine <= 0) return;
    double bend = cosine / index - sqrt(1 - (1 - cosine * cosine) / (index * index));
    for (int k = 0; k < 3; ++k) inside[k] = ray[k] / index + bend * n[k];
    if (inside[2] >= 0 || q[2] <= eye->iris_z) return;
    for (int k = 0; k < 3; ++k) spot[k] = q[k] + (eye->iris_z - q[2]) / inside[2] * inside[k];
    double r = sqrt(spot[0] * spot[0] + spot[1] * spot[1]), head[3];
    if (r < look->pupil_radius || r > eye->limbus) return;
    struct end view, lamp;
    to_head(look->axes, q, head);
    look_at(look, head, image->camera.site, by_rays, &view);
    double seen = view.open * clear * (1 - sim_fresnel(index, cosine)) / (index * index);
    if (seen <= 0) return;
    for (int e = 0; e < image->n_emitters; ++e) {
        int site = scene->emitters[image->emitters[e]].site;
        double exit[3], lit = sim_eye_refract(eye, look->sites_eye[site], spot, exit);
        if (lit <= 0) continue;
        lit *= 1 - sim_eye_whiteness(eye, sqrt(exit[0] * exit[0] + exit[1] * exit[1]));
        to_head(look->axes, exit, head);
        look_at(look, head, site, by_rays, &lamp);
        lit *= lamp.open * beam_of(look, e, lamp.away);
        add_light(look, IRIS, e, scene->person.albedo_iris / PI * seen * lit);
    }
}

static void add_eye(struct look *look) {
    const struct sim_image *image = look->image;
    const struct sim_camera *camera = &image->camera;
    int layers = image->occlusion == SIM_OCCLUSION_SOFT ? MAX_LAYERS : 1;
    for (look->pixel = 0; look->pixel < camera->pixels * camera->pixels; ++look->pixel) {
        double head[3], ray[3], point[3], normal[3], t = 0;
        pixel_ray(camera, look->pixel, head);
        to_eye(look->axes, head, ray);
        if (look->terms & (SIM_TERM_SCLERA | SIM_IMAGE_GLINT))
            for (int i = 0; i < layers; ++i) {
                if (!enter_eye(&image->scene->eye, look->camera_eye, ray, &t, point, normal)) break;
                add_surface(look, point, normal);
                t += 2e-3;
            }
        if (look->terms & SIM_TERM_IRIS) add_iris(look, ray);
    }
}

static void add_face(struct look *look) {
    const struct sim_image *image = look->image;
    for (int i = 0; i < image->n_skin; ++i) {
        const struct skin *s = &image->skin[i];
        double shown = 1;
        if (s->lid) {
            struct sim_lid_point at;
            sim_lid_measure(&look->lid, s->alpha, s->beta, s->rho, &at);
            shown -= sim_lid_open(&look->lid, &at);
        }
        look->pixel = s->pixel;
        for (int e = 0; e < image->n_emitters; ++e)
            add_light(look, FACE, e, shown * image->skin_light[(size_t)i * (size_t)image->n_emitters + (size_t)e]);
    }
}

int sim_image_render(const struct sim_image *image, double azimuth_deg, double elevation_deg,
                     double pupil_mm, double lid_opening, int terms, double *radiance) {
    const struct sim_scene *scene = image->scene;
    size_t n = (size_t)image->camera.pixels;
    struct look look = {.image = image, .pupil_radius = pupil_mm / 2, .terms = terms, .radiance = radiance};
    if (sim_image_bad_state(scene, azimuth_deg, elevation_deg, pupil_mm, lid_opening)) return -1;
    size_t planes = (size_t)image->n_emitters * (terms & SIM_IMAGE_APART ? 4 : 1);
    memset(radiance, 0, planes * n * n * sizeof *radiance);
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, look.axes);
    sim_lid_pose(&look.lid, &scene->person, elevation_deg, lid_opening);
    to_eye(look.axes, image->camera.position, look.camera_eye);
    for (int k = 0; k < scene->n_sites; ++k) {
        to_eye(look.axes, scene->sites[k].position, look.sites_eye[k]);
        look.widen[k] = sim_image_widen(scene, look.axes, k);
    }
    if (terms & SIM_TERM_FACE) add_face(&look);
    if (terms & (SIM_IMAGE_ALL - SIM_TERM_FACE)) add_eye(&look);
    return 0;
}
