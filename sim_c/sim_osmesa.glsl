// SPDX-License-Identifier: Apache-2.0
//
// sim_image.c in a fragment shader, 32-bit floats throughout: a pixel of what a sensor sees of one emitter's
// light, as (face, sclera, iris, glint). Written for itself: it shares no code and few methods with the C
// sources (the face is marched, its shadow on the eye is found on the spot, the light's way into the iris by
// plain Newton steps). Mesa's rasteriser runs both sides of every condition and leaves only loops early: so
// whatever is costly stands once, after the loop that finds where it is needed.
#version 330 core

uniform vec3 camera, aim, right, up;        // head frame
uniform float half_width, pitch, camera_radius;
uniform vec3 lamp, lamp_aim;
uniform float lamp_per_tan2, lamp_radius;
uniform float gain;                         // of everything written
uniform mat3 eye_axes;                      // columns: the eye's axes, head frame
uniform float cornea_radius, cornea_p, apex, globe, blend, limbus, haze, iris_z, index, pupil_radius;
uniform float lobe2;                        // Beckmann's alpha squared, both lenses in it
uniform vec3 albedo;                        // skin, sclera, iris, each over pi
uniform vec4 lid;                           // upper, lower, half, tilt
uniform vec4 margin;                        // thickness, softness, lash length, lash opacity
uniform float lid_radius, skin_canthus;
uniform vec3 relief_mm;                     // brow, nose, cheek
out vec4 parts;

const float X_FROM = -34.0, X_TO = 30.0, Y_FROM = -32.0, Y_TO = 32.0;

float soft_step(float t) {
    t = clamp(t, 0.0, 1.0);
    return t * t * t * (10.0 + t * (6.0 * t - 15.0));
}

// The face ------------------------------------------------------------------------------------------------

float relief(vec2 p) {
    float brow = relief_mm.x * exp(-(p.y - 21.0) * (p.y - 21.0) / 98.0);
    float cheek = relief_mm.z * exp(-(p.y + 24.0) * (p.y + 24.0) / 128.0);
    float nose = relief_mm.y * soft_step((-p.x - 13.0) / 18.0) * (1.0 - 0.3 * soft_step((p.y + 2.0) / 20.0));
    return 4.0 + brow + cheek + nose - 8.0 * soft_step((p.x - 12.0) / 20.0);
}

float face(vec2 p) {
    float r = length(p), edge = 0.9 * lid_radius, rim = sqrt(lid_radius * lid_radius - edge * edge);
    float cap = r < edge ? sqrt(lid_radius * lid_radius - r * r) : rim - (r - edge) * edge / rim;
    float low = relief(p), h = max(1.0 - abs(cap - low) / 3.0, 0.0);
    return max(cap, low) + 0.5 * h * h * h;
}

float height(vec2 p, bool relief_only) { return relief_only ? relief(p) : face(p); }

float rise(vec3 p, vec3 d, float u, bool relief_only) {
    return (-p.z - u * d.z - height(p.xy + u * d.xy, relief_only)) / u;
}

// Least height of the way from p along d (to its end) over the face, per part of the way; `least` to begin
// with. Exact to float where it matters: below 1.5 of the lens's radius.
float horizon(vec3 p, vec3 d, float radius, float least, bool relief_only) {
    int steps = int(clamp(ceil(length(d.xy)), 12.0, 400.0));
    float best = 0.0, step_u = 1.0 / float(steps);
    for (int i = 1; i <= steps; ++i) {
        float u = float(i) * step_u, h = rise(p, d, u, relief_only);
        if (h < least) {
            least = h;
            best = u;
        }
    }
    if (abs(least) > 1.5 * radius) return least;
    float from = max(best - step_u, 0.25 * step_u), to = min(best + step_u, 1.0);
    for (int i = 0; i < 14; ++i) {
        float a = mix(from, to, 0.381966), b = mix(from, to, 0.618034);
        float at_a = rise(p, d, a, relief_only), at_b = rise(p, d, b, relief_only);
        if (at_a < at_b) to = b;
        else from = a;
        least = min(least, min(at_a, at_b));
    }
    return least;
}

float skin_share(vec3 p, vec3 normal, vec3 site, float radius) {
    float r = max(radius, 0.25);
    vec3 d = site - p;
    float start = dot(normal, d) / -normal.z;
    if (start <= -r) return 1.0;
    return soft_step(0.5 + horizon(p, d, r, start, false) / (2.0 * r)) / soft_step(0.5 + start / (2.0 * r));
}

// Part of a lens that a place of the eye, in the unit direction from the centre, sees past the face.
float eye_reach(vec3 direction, vec3 site, float radius) {
    vec3 p = lid_radius * direction, d = site - p;
    float r = max(radius, 0.25);
    if (-p.z <= relief(p.xy)) return 0.0;
    return soft_step(0.5 + horizon(p, d, r, 1e6, true) / (2.0 * r));
}

// Lids ----------------------------------------------------------------------------------------------------

// Distances of a place to the upper and lower margin, mm.
vec2 to_margins(vec3 head, out vec3 radial, out vec3 upward) {
    float flat_mm = length(head.xz), rho = length(head), alpha = atan(head.x, -head.z);
    float beta = atan(head.y, flat_mm), a = alpha / lid.z, arch = 1.0 - a * a, line = lid.w * alpha;
    radial = head / rho;
    upward = vec3(-head.x / flat_mm * radial.y, flat_mm / rho, -head.z / flat_mm * radial.y);
    vec2 slope = (vec2(lid.w) + lid.xy * (-2.0 * a / lid.z)) * rho / flat_mm;
    vec2 distance_mm = rho * (vec2(line) + lid.xy * arch - vec2(beta)) / sqrt(1.0 + slope * slope);
    return vec2(distance_mm.x, -distance_mm.y);
}

float open_straight(vec2 mm) { return soft_step(mm.x / margin.y) * soft_step(mm.y / margin.y); }

float open_toward(vec3 head, vec3 toward) {
    vec3 radial, upward;
    vec2 mm = to_margins(head, radial, upward);
    if (mm.x <= 0.0 || mm.y <= 0.0) return 0.0;
    float slope = dot(toward, upward) / max(dot(toward, radial), 0.02), size = sqrt(slope * slope + 0.01);
    vec2 hidden = margin.x * vec2(size + slope, size - slope) / 2.0;
    float lash = margin.z * (size + slope) / 2.0;
    return open_straight(mm - hidden) * (1.0 - margin.w * (1.0 - soft_step((mm.x - lash) / margin.y)));
}

// Light ---------------------------------------------------------------------------------------------------

float beam(vec3 away) {
    float c = -dot(lamp_aim, away);
    if (c < 0.03) return 0.0;
    vec3 off = cross(lamp_aim, away);
    float t = dot(off, off) / (c * c) * lamp_per_tan2;
    return t > 40.0 ? 0.0 : exp(-t);
}

// Irradiance of a place from the lamp; the cosine rounded where its lens sets.
float irradiance(vec3 p, vec3 normal, out vec3 away) {
    vec3 d = lamp - p;
    float n = length(d), wide = lamp_radius / n + 1e-9;
    away = d / n;
    float c = dot(away, normal), t = max(c + wide, 0.0);
    return (c >= wide ? c : t * t / (4.0 * wide)) / (n * n) * beam(away);
}

float fresnel(float c) {
    float t = sqrt(1.0 - (1.0 - c * c) / (index * index));
    float s = (c - index * t) / (c + index * t), p = (t - index * c) / (t + index * c);
    return (s * s + p * p) / 2.0;
}

// The eye -------------------------------------------------------------------------------------------------

// Distance from the centre less the surface's there; the surface's outward normal. Eye frame.
float outside(vec3 p, out vec3 normal) {
    float flat_mm = length(p.xy), r = length(p), s = flat_mm / r, c = p.z / r;
    float b = cornea_radius - cornea_p * apex, a = s * s + cornea_p * c * c;
    float rest = apex * (2.0 * cornea_radius - cornea_p * apex), root = sqrt(b * b * c * c + a * rest);
    float cornea = b * c > 0.0 ? rest / (root + b * c) : (root - b * c) / a;
    float slope = s * cornea * (b - (1.0 - cornea_p) * c * cornea) / root, gap = cornea - globe;
    float h = max(1.0 - abs(gap) / blend, 0.0);
    float share = gap > 0.0 ? 1.0 - h * h / 2.0 : h * h / 2.0;
    slope *= share;
    float rho = max(cornea, globe) + h * h * h * blend / 6.0;
    vec2 out_ward = flat_mm > 1e-6 ? p.xy / flat_mm : vec2(0.0);
    normal = normalize(vec3((s - slope / rho * c) * out_ward, c + slope / rho * s));
    return r - rho;
}

float whiteness(float r) { return soft_step((r - limbus) / haze + 0.5); }

float past_bulge(vec3 head, vec3 away, float distance_mm, float radius) {
    vec3 c = (apex - cornea_radius) * eye_axes[2] - head;
    float along = dot(c, away);
    if (along <= 0.0) return 1.0;
    float miss = length(c - along * away) - cornea_radius, spread = (radius + 0.3) * along / distance_mm;
    return soft_step(0.5 + miss / (2.0 * spread));
}

// (sclera, glint) of a place of the eye's surface.
vec2 surface(vec3 p, vec3 normal_eye) {
    vec3 head = eye_axes * p, normal = eye_axes * normal_eye, view = camera - head, away;
    float far = length(view);
    view /= far;
    float facing = dot(view, normal);
    if (facing <= 0.0) return vec2(0.0);
    float light = irradiance(head, normal, away);
    float open = open_toward(head, view);
    if (light == 0.0 || open == 0.0) return vec2(0.0);
    open *= open_toward(head, away);
    if (open == 0.0) return vec2(0.0);
    vec3 direction = normalize(head);
    open *= eye_reach(direction, camera, camera_radius) * eye_reach(direction, lamp, lamp_radius);
    float white = p.z > 0.0 ? whiteness(length(p.xy)) : 1.0, lamp_mm = length(lamp - head);
    float sclera = albedo.y * white * open * light;
    if (sclera > 0.0)
        sclera *= past_bulge(head, view, far, camera_radius) * past_bulge(head, away, lamp_mm, lamp_radius);
    float glint = 0.0;
    vec3 h = normalize(view + away);
    float c = dot(h, normal);
    if (c > 0.1 && dot(normal, away) > 0.0) {
        vec3 off = cross(normal, h);
        float slope2 = dot(off, off) / (c * c * lobe2);
        if (slope2 <= 30.0)
            glint = open * beam(away) / (lamp_mm * lamp_mm) * exp(-slope2) /
                    (3.14159265 * lobe2 * c * c * c * c) * fresnel(dot(away, h)) / (4.0 * facing);
    }
    return vec2(sclera, glint);
}

// Irradiance of a spot of the iris per intensity at a site: Fermat's way by Newton's steps over the cornea's
// (x, y). exit: where it crosses. All in the eye's frame.
float through_cornea(vec3 site, vec3 spot, out vec3 exit) {
    vec3 toward = site - spot;
    vec2 q = spot.xy + toward.xy * (apex - iris_z) * 0.8 / index / (max(toward.z, 0.1) + length(toward.xy)) *
                           (1.0 - dot(spot.xy, spot.xy) / (1.3 * limbus * limbus));
    float furthest2 = 0.9 * cornea_radius * cornea_radius / max(cornea_p, 0.1);
    float hxx, hyy, hxy, s1, s2, root, step_mm = 1.0, lift = 0.0;
    vec3 u, v;
    vec2 slope;
    for (int i = 0; i < 24; ++i) {
        float r2 = dot(q, q);
        root = sqrt(cornea_radius * cornea_radius - cornea_p * r2);
        exit = vec3(q, apex - r2 / (cornea_radius + root));
        u = exit - site;
        v = exit - spot;
        s1 = length(u);
        s2 = length(v);
        u /= s1;
        v /= s2;
        slope = -q / root;
        float k1 = 1.0 / s1, k2 = index / s2, bend = u.z + index * v.z;
        float cube = cornea_p / (root * root * root);
        vec2 gu = u.xy + u.z * slope, gv = v.xy + v.z * slope, g = gu + index * gv;
        hxx = (1.0 + slope.x * slope.x) * (k1 + k2) - gu.x * gu.x * k1 - gv.x * gv.x * k2 -
              bend * (1.0 / root + q.x * q.x * cube);
        hyy = (1.0 + slope.y * slope.y) * (k1 + k2) - gu.y * gu.y * k1 - gv.y * gv.y * k2 -
              bend * (1.0 / root + q.y * q.y * cube);
        hxy = slope.x * slope.y * (k1 + k2) - gu.x * gu.y * k1 - gv.x * gv.y * k2 - bend * q.x * q.y * cube;
        if (step_mm < 3e-6 && lift == 0.0) break;
        float least = (hxx + hyy) / 2.0 - sqrt((hxx - hyy) * (hxx - hyy) / 4.0 + hxy * hxy);
        lift = max(0.01 - least, 0.0);
        float a = hxx + lift, b = hyy + lift, det = a * b - hxy * hxy;
        vec2 d = -vec2(b * g.x - hxy * g.y, a * g.y - hxy * g.x) / det;
        step_mm = length(d);
        d *= min(1.0, 0.7 / max(step_mm, 1e-9));
        vec2 next = q + d;
        q = dot(next, next) > furthest2 ? q + d * 0.1 : next;
        if (dot(q, q) > furthest2) q *= 0.99 * sqrt(furthest2 / dot(q, q));
    }
    if (step_mm > 1e-4 || lift > 0.0) return 0.0;
    float metric = 1.0 + dot(slope, slope), size = sqrt(metric), det = (hxx * hyy - hxy * hxy) / metric;
    float cos_out = -(u.z - dot(slope, u.xy)) / size, cos_in = (v.z - dot(slope, v.xy)) / size;
    if (det <= 0.0 || cos_out <= 0.0 || cos_in <= 0.0 || v.z <= 0.0) return 0.0;
    return v.z * (1.0 - fresnel(cos_out)) * index * index * cos_out * cos_in / (s1 * s1 * s2 * s2 * det);
}

float iris(vec3 near, vec3 ray) {  // near: the ray's place nearest to the eye's centre
    float s = apex - near.z, a = ray.x * ray.x + ray.y * ray.y + cornea_p * ray.z * ray.z;
    float b = dot(near.xy, ray.xy) + cornea_radius * ray.z - cornea_p * s * ray.z;
    float c = dot(near.xy, near.xy) - 2.0 * cornea_radius * s + cornea_p * s * s, disc = b * b - a * c;
    if (disc <= 0.0) return 0.0;
    vec3 q = near + ray * (b < 0.0 ? c / (sqrt(disc) - b) : -(b + sqrt(disc)) / a);
    float r2 = dot(q.xy, q.xy), root2 = cornea_radius * cornea_radius - cornea_p * r2;
    if (root2 <= 0.0 || apex - q.z > cornea_radius) return 0.0;
    vec3 normal = normalize(vec3(q.xy, sqrt(root2)));
    float clear = 1.0 - whiteness(sqrt(r2)), cosine = -dot(ray, normal);
    if (clear <= 0.0 || cosine <= 0.0) return 0.0;
    float bend = cosine / index - sqrt(1.0 - (1.0 - cosine * cosine) / (index * index));
    vec3 inside = ray / index + bend * normal;
    if (inside.z >= 0.0 || q.z <= iris_z) return 0.0;
    vec3 spot = q + (iris_z - q.z) / inside.z * inside, exit;
    float r = length(spot.xy);
    if (r < pupil_radius || r > limbus) return 0.0;
    vec3 head = eye_axes * q;
    float seen = open_toward(head, normalize(camera - head)) * clear * (1.0 - fresnel(cosine));
    seen /= index * index;
    if (seen == 0.0) return 0.0;
    float lit = through_cornea(transpose(eye_axes) * lamp, spot, exit);
    vec3 exit_head = eye_axes * exit, away = normalize(lamp - exit_head);
    lit *= (1.0 - whiteness(length(exit.xy))) * beam(away) * open_toward(exit_head, away);
    if (lit <= 0.0) return 0.0;
    return albedo.z * seen * lit * eye_reach(normalize(head), camera, camera_radius) *
           eye_reach(normalize(exit_head), lamp, lamp_radius);
}

// (sclera, iris, glint) along a ray in the eye's frame.
vec3 eye(vec3 from, vec3 ray) {
    vec3 sum = vec3(0.0), normal, near = from - dot(from, ray) * ray;
    near -= dot(near, ray) * ray;  // again: what rounding left of a long way
    float reach = apex + blend, room = reach * reach - dot(near, near);
    if (room <= 0.0) return sum;
    sum.y = iris(near, ray);
    float end = sqrt(room), t = -end, gap = outside(near + t * ray, normal);
    while (t < end) {
        float a = t, b = t, ga = gap, gb = 1.0, root;
        while (t < end && !(ga > 0.0 && gb <= 0.0)) {  // on to the next place where the ray goes in
            a = t;
            ga = gap;
            t += max(abs(gap) / 1.3, 4e-3);
            gap = outside(near + t * ray, normal);
            b = t;
            gb = gap;
        }
        if (!(ga > 0.0 && gb <= 0.0)) break;
        for (int j = 0; j < 12; ++j) {  // regula falsi (Illinois)
            root = a + (b - a) * ga / (ga - gb);
            float g = outside(near + root * ray, normal);
            if (g <= 0.0) {
                b = root;
                gb = g;
                ga *= 0.5;
            } else {
                a = root;
                ga = g;
                gb *= 0.5;
            }
            if (abs(g) < 1e-6) break;
        }
        sum.xz += surface(near + root * ray, normal);
    }
    return sum;
}

// Light that the skin at one place sends to the camera.
float skin_light(vec3 p) {
    const float E = 0.02;
    vec2 slope = vec2(face(p.xy + vec2(E, 0.0)) - face(p.xy - vec2(E, 0.0)),
                      face(p.xy + vec2(0.0, E)) - face(p.xy - vec2(0.0, E))) / (2.0 * E);
    vec3 normal = normalize(vec3(-slope, -1.0)), away, radial, upward;
    float light = irradiance(p, normal, away);
    vec2 mm = to_margins(p, radial, upward);
    bool may_open = abs(atan(p.x, -p.z)) < skin_canthus && abs(asin(radial.y)) < 1.134464 && -p.z > 1.0;
    float on_lids = 1.0 - soft_step((length(p) - (lid_radius + 1.0)) / 1.5);
    light *= may_open ? 1.0 - on_lids * open_straight(mm) : 1.0;
    if (light == 0.0) return 0.0;
    return light * skin_share(p, normal, camera, camera_radius) * skin_share(p, normal, lamp, lamp_radius);
}

// Skin along a ray: every place where it enters the height field within the face's rectangle.
float skin(vec3 ray) {
    vec2 low = (vec2(X_FROM, Y_FROM) - camera.xy) / ray.xy, high = (vec2(X_TO, Y_TO) - camera.xy) / ray.xy;
    vec2 first = min(low, high), final = max(low, high);
    float t = max(max(first.x, first.y), 0.0), end = min(final.x, final.y), sum = 0.0;
    // Nothing stands further forward than this, nor lies further back than that.
    float forward = max(lid_radius, 4.0 + relief_mm.x + relief_mm.y + relief_mm.z) + 0.5, back = -60.0;
    if (ray.z > 0.0) {
        t = max(t, (-forward - camera.z) / ray.z);
        end = min(end, (-back - camera.z) / ray.z);
    }
    vec3 p = camera + t * ray;
    float gap = -p.z - face(p.xy);
    while (t < end) {
        float a = t, b = t, ga = gap, gb = 1.0;
        while (t < end && !(ga > 0.0 && gb <= 0.0)) {
            a = t;
            ga = gap;
            t = min(t + (gap > 0.0 ? 0.06 + 0.3 * gap : 0.25), end);  // a grazing ray is soon through
            p = camera + t * ray;
            gap = -p.z - face(p.xy);
            b = t;
            gb = gap;
        }
        if (!(ga > 0.0 && gb <= 0.0)) break;
        for (int j = 0; j < 12; ++j) {
            float next = a + (b - a) * ga / (ga - gb);
            p = camera + next * ray;
            float g = -p.z - face(p.xy);
            if (g <= 0.0) {
                b = next;
                gb = g;
                ga *= 0.5;
            } else {
                a = next;
                ga = g;
                gb *= 0.5;
            }
            if (abs(g) < 2e-6) break;
        }
        sum += skin_light(p);
    }
    return albedo.x * sum;
}

void main() {
    vec2 at = vec2(gl_FragCoord.x * pitch - half_width, half_width - gl_FragCoord.y * pitch);
    vec3 ray = normalize(aim + at.x * right + at.y * up);
    vec3 of_eye = eye(transpose(eye_axes) * camera, transpose(eye_axes) * ray);
    parts = gain * vec4(skin(ray), of_eye);
}
