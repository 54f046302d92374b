// SPDX-License-Identifier: Apache-2.0
//
// One headset on one person: the response of every (sensor, emitter) pair to gaze, pupil and lids.
//
// Frame     head frame = OpenXR's axes (+x right, +y up, -z forward), origin at the eye's centre of rotation,
//           right eye: +x is temporal. Straight ahead the eye looks along -z and its corneal apex lies near z
//           = -13 mm; the headset is in front of it, at negative z. Ports are given in the headset's frame,
//           whose origin is where a nominal person's centre of rotation is; person.eye_position_mm and slip
//           move the two against each other.
// Response  irradiance-like: integral over the scene of
//               emitter beam / distance^2 * reflection * sensor window / distance^2,
//           per unit axial intensity of the emitter, 1/mm^2. A window is exp(-tan^2(angle)/(2 tan^2 sigma)).
//           One reflection only; skin, sclera and iris Lambertian; pupil black; the eye's front has a
//           Beckmann glint whose width is the tear film's roughness and both lenses' radii (a disc of radius
//           r at distance d widens the lobe of half vectors by r / (2 d)).
// Left out  interreflection, the lashes' own light, the lids' margin between skin and eye (black), the
//           pupil's retro-reflection, the pupil's decentration, posterior cornea and lens, and of the two
//           paths from a site beside the eye to a spot of the iris next to a caustic the longer one.
#ifndef SIM_SCENE_H
#define SIM_SCENE_H

#include <stddef.h>

#include "sim_eye.h"

// cdef begin
enum { SIM_MAX_PORTS = 256, SIM_MAX_PUPILS = 32, SIM_MAX_LIDS = 32 };

// A sensor or an emitter.
struct sim_port {
    double position_mm[3], aim[3];  // headset frame; aim need not be a unit vector
    double sigma_deg;               // of the angular window or beam
    double radius_mm;               // of the lens, as seen from the eye; 0 = a point
};

// How finely to integrate each term: 1 is the default, errors fall and costs grow as it grows; 0.1..16. NULL
// anywhere below means sim_quality_default().
struct sim_quality {
    double sclera, iris, glint, face;
    double tolerance;  // absolute, of one response: a cheaper model may stand in for a term whose own
                       // estimate of what that changes is below this; 0 = never
};

// Terms of the response that vary slowly with gaze.
enum { SIM_TERM_FACE = 1, SIM_TERM_SCLERA = 2, SIM_TERM_IRIS = 4, SIM_TERM_SMOOTH = 7 };

struct sim_scene;

struct sim_quality sim_quality_default(void);

// Check and prepare a scene: integrates the skin, shadows and all (about 0.1 s); nothing does so later.
//   slip_mm   added to every port's position; NULL = none.
//   error     receives one line when the scene is impossible: a port inside the eye or the face or with a
//             spot of light too narrow to integrate (sigma below 0.2 mm where it meets face or eye), a number
//             that is not finite or out of any anatomy's range.
// Returns the scene, or NULL.
struct sim_scene *sim_scene_open(const struct sim_person *person, const struct sim_port *sensors,
                                 int n_sensors, const struct sim_port *emitters, int n_emitters,
                                 const double *slip_mm, const struct sim_quality *quality, char *error,
                                 size_t error_bytes);
void sim_scene_close(struct sim_scene *scene);

// Sum of the chosen terms. One call shares its work over all pupils and lids.
//   pupil_mm    ascending diameters, n_pupils <= SIM_MAX_PUPILS; lid_opening likewise
//   out         [n_pupils][n_lids][sensors][emitters]
// Returns 0, or -1 for bad arguments or lack of memory. Reentrant.
int sim_scene_smooth(const struct sim_scene *scene, double azimuth_deg, double elevation_deg, int terms,
                     const double *pupil_mm, int n_pupils, const double *lid_opening, int n_lids,
                     double *out);

// The glint. out [n_lids][sensors][emitters].
int sim_scene_glint(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                    const double *lid_opening, int n_lids, double *out);

// What the face does to one port, as far as it was found to matter.
struct sim_port_facts {
    int eye_clear;      // 1 = hides nothing of its lens from what open lids show at gazes within 30 degrees
    int skin_clear;     // 1 = no shadow's edge falls on skin that the scene's light reaches
    double widened_mm;  // the radius that softens its shadows, where its own is smaller; else 0
};

// How the skin was integrated.
struct sim_face_facts {
    int panel_spots, lid_spots;  // evaluated for closed lids; kept for lid poses (0 = no light on lids)
    double panel_tolerance;      // a panel's change when halved, in units of the mean response of pairs
    double panel_goal;           // the same as it was meant to be, before too many hard shadows loosened it
    double lid_step_mm;          // spacing of the latter
};

// Facts about a sensor (emitter = 0) or an emitter (1). Returns 0, or -1 when there is no such port.
int sim_scene_port_facts(const struct sim_scene *scene, int emitter, int number,
                         struct sim_port_facts *facts);
void sim_scene_face_facts(const struct sim_scene *scene, struct sim_face_facts *facts);

// Share of a port's lens that the face leaves to the eye in the direction (alpha to +x, beta up, as the lids
// have it), 0..1; NAN when there is no such port or direction.
double sim_scene_eye_reach(const struct sim_scene *scene, int emitter, int number, double alpha_deg,
                           double beta_deg);

// A point of the eye that mirrors an emitter into a sensor.
struct sim_mirror_light {
    double point_mm[3];   // head frame
    double theta_deg;     // its direction from the centre of rotation, off the optical axis
    double sensor_mm, emitter_mm, cosine;  // both distances; cosine of incidence
    // of the path length's second derivatives in the tangent plane, 1/mm^2; < 0 a saddle
    double determinant;
    double response;      // of a perfectly smooth eye, both windows included, lids and face not: 1/mm^2
    double open;          // share that lids and face leave
};

// The mirror points of one pair, as if the eye were perfectly smooth and both lenses were points: all of
// them, from the optical axis outward. Their number is odd and one more of them have a positive determinant
// than a negative one, whatever the gaze: a self-test. out has room for most. Returns their number or -1.
int sim_scene_mirrors(const struct sim_scene *scene, double azimuth_deg, double elevation_deg,
                      double lid_opening, int sensor, int emitter, struct sim_mirror_light *out, int most);

// How many lobes (a pair of places at one gaze) sim_scene_glint() has treated since the scene was opened:
// [0] by the mirror point and its neighbours because of quality.tolerance, [1] by the full quadrature,
// [2] not at all, nothing of the lobe being in view.
void sim_scene_glint_counts(const struct sim_scene *scene, long long counts[3]);

// Height of the face over the frontal plane (mm forward of the centre of rotation), for pictures and checks.
double sim_person_face_mm(const struct sim_person *person, double x_mm, double y_mm);

// H (mm) of sim_face.h: how high a place stands above the horizon that the face makes for a point.
// relief_only: 0 for a point of the skin, with all of the face; 1 for a point above the orbit, without the
// lids' bulge. For checks and pictures.
double sim_person_horizon_mm(const struct sim_person *person, const double from_mm[3], const double to_mm[3],
                             int relief_only);

// Share of a lens that the face leaves to the skin at (x, y), as the skin's term has it.
double sim_person_skin_share(const struct sim_person *person, double x_mm, double y_mm, const double to_mm[3],
                             double lens_radius_mm);

// The eye's profile: distance from the centre of rotation at an angle from the optical axis.
double sim_person_profile_mm(const struct sim_person *person, double angle_deg);

// sim_eye_refract() for one person: irradiance of a spot on the iris (eye frame: +z out of the cornea) per
// intensity of a point source at a site, 1/mm^2; exit receives where the light crosses the cornea. For
// checks.
double sim_person_iris_light(const struct sim_person *person, const double site_mm[3],
                             const double spot_mm[3], double exit_mm[3]);
// cdef end

#endif
