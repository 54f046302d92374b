// SPDX-License-Identifier: Apache-2.0
#include "sim_image_inside.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846

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

void sim_image_ray(const struct sim_camera *camera, int pixel, double ray[3]) {
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
        struct sim_image_skin *skin = realloc(image->skin, (size_t)room * sizeof *skin);
        if (skin) image->skin = skin;
        double *light =
            realloc(image->skin_light, (size_t)room * (size_t)image->n_emitters * sizeof *light);
        if (light) image->skin_light = light;
        if (!skin || !light) return -1;
        image->room = room;
    }
    struct sim_image_skin *s = &image->skin[image->n_skin];
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
        sim_image_ray(&camera, i, ray);
        for (int layer = 0; layer < (occlusion == SIM_OCCLUSION_SOFT ? SIM_IMAGE_LAYERS : 1); ++layer) {
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

static void add_face(struct sim_image_look *look) {
    const struct sim_image *image = look->image;
    for (int i = 0; i < image->n_skin; ++i) {
        const struct sim_image_skin *s = &image->skin[i];
        double shown = 1;
        if (s->lid) {
            struct sim_lid_point at;
            sim_lid_measure(&look->lid, s->alpha, s->beta, s->rho, &at);
            shown -= sim_relief_on_lids(&image->scene->face.relief, s->rho) * sim_lid_open(&look->lid, &at);
        }
        look->pixel = s->pixel;
        const double *light = image->skin_light + (size_t)i * (size_t)image->n_emitters;
        for (int e = 0; e < image->n_emitters; ++e)
            sim_image_add(look, SIM_PART_FACE, e, shown * light[e]);
    }
}

int sim_image_render(const struct sim_image *image, double azimuth_deg, double elevation_deg,
                     double pupil_mm, double lid_opening, int terms, double *radiance) {
    const struct sim_scene *scene = image->scene;
    size_t n = (size_t)image->camera.pixels;
    struct sim_image_look look = {
        .image = image, .pupil_radius = pupil_mm / 2, .terms = terms, .radiance = radiance};
    if (sim_image_bad_state(scene, azimuth_deg, elevation_deg, pupil_mm, lid_opening)) return -1;
    size_t planes = (size_t)image->n_emitters * (terms & SIM_IMAGE_APART ? 4 : 1);
    memset(radiance, 0, planes * n * n * sizeof *radiance);
    sim_eye_orient(&scene->eye, azimuth_deg, elevation_deg, look.axes);
    sim_lid_pose(&look.lid, &scene->person, elevation_deg, lid_opening);
    sim_image_to_eye(look.axes, image->camera.position, look.camera_eye);
    for (int k = 0; k < scene->n_sites; ++k) {
        sim_image_to_eye(look.axes, scene->sites[k].position, look.sites_eye[k]);
        look.widen[k] = sim_image_widen(scene, look.axes, k);
    }
    if (terms & SIM_TERM_FACE) add_face(&look);
    if (terms & (SIM_IMAGE_ALL - SIM_TERM_FACE)) sim_image_add_eye(&look);
    return 0;
}
