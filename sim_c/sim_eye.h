// SPDX-License-Identifier: Apache-2.0
//
// The eye as an analytic surface of revolution, in its own frame: origin at the centre of rotation, +z out of
// the cornea along the optical axis. Lengths in mm, angles in radians unless a name says otherwise.
//
// Seen from the centre of rotation the outside is a radius rho(theta), theta from the axis: the smooth
// maximum (cubic, C2) of the corneal conic and the scleral globe. The smoothing is the limbus: without it
// there is no fold in the surface's normals and no bright ring in the maps.
#ifndef SIM_EYE_H
#define SIM_EYE_H

// cdef begin
// A person, as far as light near the eye is concerned. The right eye: +x is temporal.
struct sim_person {
    double cornea_radius_mm, cornea_asphericity;  // apical radius; Q of the conic, 0 = sphere
    double limbus_radius_mm;                      // where conic and globe meet
    double limbus_blend_mm;  // reach of the smooth maximum, in distance between the two surfaces
    double limbus_haze_mm;   // width over which the cornea turns from clear to white
    double globe_radius_mm;
    double iris_depth_mm;                           // iris plane behind the corneal apex
    double kappa_azimuth_deg, kappa_elevation_deg;  // optical axis minus visual axis, looking straight ahead
    double refractive_index;                        // everything behind the corneal surface
    double roughness;                               // Beckmann alpha of the tear film
    double albedo_sclera, albedo_iris, albedo_skin;
    double lid_upper_deg, lid_lower_deg;   // margins' elevation above the optical axis's, open, looking ahead
    double canthus_deg, canthus_tilt_deg;  // half width of the opening; rise of its line per 45 degrees
    double lid_upper_follow, lid_lower_follow;  // part of the gaze's elevation that each margin follows
    double lid_close_at;                        // where they meet: 0 = at the lower margin, 1 = at the upper
    double lid_thickness_mm;            // height of the margin above the eye: hides what lies behind it
    double lid_softness_mm;             // rounding of the margin: width of its edge in light
    double lid_radius_mm;               // of the lids' outer surface about the centre of rotation
    double lash_length_mm;              // how far the upper lashes stand off the eye, above their margin
    double lash_opacity;                // share of the light that is lost in their fan; 0 = no lashes
    double brow_mm, nose_mm, cheek_mm;  // how far these stand forward of the orbital plane
    double eye_position_mm[3];          // of the centre of rotation in the headset's frame
};
// cdef end

struct sim_eye {
    double radius, p, apex, globe, blend;  // conic r^2 = 2 radius s - p s^2 at depth s behind the apex
    double limbus, haze, iris_z, index;
    double rest[9];  // columns: the eye's axes at rest, in the head frame
    double cos_clear, cos_white, cos_blend;  // of theta: last of the clear cornea, first of the white sclera,
                                             // first of the bare globe
};

void sim_eye_init(struct sim_eye *eye, const struct sim_person *person);

// Radius from the centre of rotation and its derivative by theta, at polar angle with the given sine and
// cosine.
double sim_eye_rho(const struct sim_eye *eye, double sin_theta, double cos_theta, double *derivative);

// How white the surface is at distance r from the axis: 0 clear cornea .. 1 sclera (C2).
double sim_eye_whiteness(const struct sim_eye *eye, double r);

// The eye's axes (columns, row-major 3 x 3) in the head frame when its visual axis points at the given Fick
// angles: Listing's law, the rotation about the cross product of rest and gaze.
void sim_eye_orient(const struct sim_eye *eye, double azimuth_deg, double elevation_deg, double axes[9]);

// Light between an outside point and a point of the iris, through the cornea (Fermat's path, Newton's
// method).
//   site, spot   eye frame; spot on the iris plane
//   exit         receives where the path crosses the cornea
// Returns transfer = cos(iris) * Fresnel transmission * (solid angle at the site per area across the ray at
// the spot), in 1/mm^2: the irradiance of the iris per intensity of a source at the site. 0 when no path
// exists.
double sim_eye_refract(const struct sim_eye *eye, const double site[3], const double spot[3], double exit[3]);

// Fresnel reflectance, unpolarised, from outside, at the given cosine of incidence.
double sim_fresnel(double index, double cos_in);

// 0 below 0, 1 above 1, C2 between.
static inline double sim_step(double t) {
    if (t <= 0) return 0;
    if (t >= 1) return 1;
    return t * t * t * (10 + t * (6 * t - 15));
}

static inline double sim_dot(const double a[3], const double b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

#endif
