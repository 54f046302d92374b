// SPDX-License-Identifier: Apache-2.0
//
// The eye's outside as a mirror: its rings about the optical axis, which of them come near to mirroring one
// site into another, and the points that do. Eye frame (sim_eye.h); mm and radians.
//
// Slope     of the half vector h = l + v of the unit vectors to two sites, against the unit normal n: its
//           tangential part over n.h. A mirror point has slope 0; Beckmann's lobe is exp(-slope^2 / alpha^2).
// Miss      each ring has one azimuth where the slope is least; that slope, positive when h leans further out
//           than n, is the ring's miss. It starts positive on the axis and ends negative behind, so its
// roots,
//           the mirror points, are odd in number; where it only touches zero is the fold at the limbus.
#ifndef SIM_MIRROR_H
#define SIM_MIRROR_H

#include "sim_eye.h"

enum { SIM_PROFILE_RINGS = 128, SIM_PROFILE_PIECES = 16, SIM_STRETCHES = 64, SIM_BANDS = 512 };

struct sim_ring {
    double theta, r, z;   // polar angle; the ring's radius and height
    double n_out, n_up;   // unit normal: away from the axis, along it
    double along, area;   // arc length along the profile per d theta; area per d theta d phi
};

// Part of a piece of the profile.
struct sim_band {
    double from, to;       // theta
    struct sim_ring ring;  // in the middle
    double rate, along;    // bounds: |d angle of the normal / d theta|; arc length per d theta
    int half;              // index of its first half, the second follows; -1 for none
};

// The profile's analytic pieces, which end where the limbus' blend begins, is centred and ends, and rings in
// each of them.
struct sim_profile {
    int n_rings, n_pieces;
    int first[SIM_PROFILE_PIECES + 1];  // ring that starts each piece; a piece has its own ring at both ends
    int convex[SIM_PROFILE_PIECES];     // along it; the miss only falls there, as h turns against n
    struct sim_ring rings[SIM_PROFILE_RINGS];
    int n_bands;  // the first n_pieces of them are the pieces
    struct sim_band bands[SIM_BANDS];
};

// Where a ring comes nearest to mirroring one site into the other.
struct sim_facing {
    double c, s;     // cosine and sine of the azimuth; on entry of sim_ring_face() where to start
    double miss;     // signed slope there
    double pace;     // change of slope per radian around the ring
    double cosine;   // of incidence, of light mirrored by the half vector
    double nearest;  // distance of the nearer site
};

// A point that mirrors one site into the other.
struct sim_mirror {
    double theta, point[3], normal[3];
    double distance_a, distance_b, cosine;  // of incidence
    // of the second derivatives of |a - p| + |p - b| in the tangent plane, 1/mm^2: < 0 at
    double determinant;
                         // a saddle
};

// Part of the profile where the miss is within reach.
struct sim_stretch {
    double from, to;    // theta
    double steepest;    // largest |d sine of miss / d theta| in it
    int crossings;      // changes of the miss' sign seen in it
    int closed[2];      // whether the miss is out of reach at either end
};

void sim_ring_at(const struct sim_eye *eye, double theta, struct sim_ring *ring);

void sim_profile_init(struct sim_profile *profile, const struct sim_eye *eye);

// Newton's way to the azimuth of least slope. Start anywhere in the half that faces the sites. tolerance: of
// the slope's change by the last step but one; the miss is good to its square.
void sim_ring_face(const struct sim_ring *ring, const double a[3], const double b[3], double tolerance,
                   struct sim_facing *facing);

// Azimuth to start from: the sites' mean direction.
void sim_facing_start(const double a[3], const double b[3], struct sim_facing *facing);

// All stretches in which |miss| <= reach: the profile's rings first, then halved cells wherever the miss may
// dip within reach between them. Returns their number, at most SIM_STRETCHES, or 0 when the search has no end
// (a nearly tangent site's miss jumps from ring to ring).
int sim_profile_scan(const struct sim_profile *profile, const struct sim_eye *eye, const double a[3],
                     const double b[3], double reach, struct sim_stretch *out);

// The root of the miss between two thetas of opposite sign, to a tolerance of the miss; facing is where to
// start and receives its azimuth, slope d miss / d theta.
double sim_mirror_root(const struct sim_eye *eye, const double a[3], const double b[3], double from,
                       double to,
                       double tolerance, struct sim_facing *facing, double *slope);

// All mirror points, from the axis outward; at most `most`. Returns their number: odd, and one more of them
// with a positive determinant than with a negative one.
int sim_mirror_points(const struct sim_profile *profile, const struct sim_eye *eye, const double a[3],
                      const double b[3], struct sim_mirror *out, int most);

#endif
