// SPDX-License-Identifier: Apache-2.0
//
// The eye in an image: where a ray meets it, and what light leaves there.
#include <math.h>

#include "sim_image_inside.h"

#define PI 3.14159265358979323846

// Distance from the centre less the surface's there, at a place on a ray; its slope along the ray.
static double outside(const struct sim_eye *eye, const double from[3], const double ray[3], double t,
                      double point[3], double normal[3]) {
    for (int k = 0; k < 3; ++k) point[k] = from[k] + t * ray[k];
    double flat = sqrt(point[0] * point[0] + point[1] * point[1]);
    double r = sqrt(flat * flat + point[2] * point[2]);
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

// One end of the light's way at a place of the eye: the unit vector to a site, its distance, and what lids
// and face let through. Head frame.
struct end {
    double away[3], distance, open;
};

static void look_at(const struct sim_image_look *look, const double head[3], int site, int by_rays,
                    struct end *end) {
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
static double past_bulge(const struct sim_image_look *look, const double head[3], const struct end *end,
                         int site) {
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
static int eye_between(const struct sim_image_look *look, const double point[3], const double normal[3],
                       int site) {
    double to[3], off[3], p[3], n[3], t = 0;
    for (int k = 0; k < 3; ++k) off[k] = point[k] + 1e-4 * normal[k];
    for (int k = 0; k < 3; ++k) to[k] = look->sites_eye[site][k] - off[k];
    double size = sqrt(sim_dot(to, to));
    for (int k = 0; k < 3; ++k) to[k] /= size;
    return enter_eye(&look->image->scene->eye, off, to, &t, p, n) && t < size;
}

static double beam_of(const struct sim_image_look *look, int e, const double away[3]) {
    return sim_window_weight(&look->image->scene->emitters[look->image->emitters[e]], away);
}

// Sclera and glint where a ray enters the eye.
static void add_surface(const struct sim_image_look *look, const double point[3], const double normal[3]) {
    const struct sim_image *image = look->image;
    const struct sim_scene *scene = image->scene;
    int by_rays = image->occlusion == SIM_OCCLUSION_RAYS, own = image->camera.site;
    double head[3], up[3], r = sqrt(point[0] * point[0] + point[1] * point[1]);
    sim_image_to_head(look->axes, point, head);
    sim_image_to_head(look->axes, normal, up);
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
            double light = scene->person.albedo_sclera / PI * white * seen * lit * beam * bulge;
            sim_image_add(look, SIM_PART_SCLERA, e, light);
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
        sim_image_add(look, SIM_PART_GLINT, e, mirrored * view.open * beam / (distance * distance));
    }
}

// The iris, where a ray through the cornea meets it.
static void add_iris(const struct sim_image_look *look, const double ray[3]) {
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
    sim_image_to_head(look->axes, q, head);
    look_at(look, head, image->camera.site, by_rays, &view);
    double seen = view.open * clear * (1 - sim_fresnel(index, cosine)) / (index * index);
    if (seen <= 0) return;
    for (int e = 0; e < image->n_emitters; ++e) {
        int site = scene->emitters[image->emitters[e]].site;
        double exit[3], lit = sim_eye_refract(eye, look->sites_eye[site], spot, exit);
        if (lit <= 0) continue;
        lit *= 1 - sim_eye_whiteness(eye, sqrt(exit[0] * exit[0] + exit[1] * exit[1]));
        sim_image_to_head(look->axes, exit, head);
        look_at(look, head, site, by_rays, &lamp);
        lit *= lamp.open * beam_of(look, e, lamp.away);
        sim_image_add(look, SIM_PART_IRIS, e, scene->person.albedo_iris / PI * seen * lit);
    }
}

void sim_image_add_eye(struct sim_image_look *look) {
    const struct sim_image *image = look->image;
    const struct sim_camera *camera = &image->camera;
    int layers = image->occlusion == SIM_OCCLUSION_SOFT ? SIM_IMAGE_LAYERS : 1;
    for (look->pixel = 0; look->pixel < camera->pixels * camera->pixels; ++look->pixel) {
        double head[3], ray[3], point[3], normal[3], t = 0;
        sim_image_ray(camera, look->pixel, head);
        sim_image_to_eye(look->axes, head, ray);
        if (look->terms & (SIM_TERM_SCLERA | SIM_IMAGE_GLINT))
            for (int i = 0; i < layers; ++i) {
                if (!enter_eye(&image->scene->eye, look->camera_eye, ray, &t, point, normal)) break;
                add_surface(look, point, normal);
                t += 2e-3;
            }
        if (look->terms & SIM_TERM_IRIS) add_iris(look, ray);
    }
}
