// SPDX-License-Identifier: Apache-2.0
//
// The length of a path of light through the cornea, which Fermat's principle makes stationary.
#ifndef SIM_PATH_H
#define SIM_PATH_H

#include "sim_wide.h"

// Fermat's length site - (x, y) on the cornea - spot: slopes and second derivatives, lengths of both legs.
// n: refractive index.
struct sim_path {
    double gx, gy, hxx, hyy, hxy, per1, per2, ux, uy, uz, vx, vy, vz, zx, zy, z;
};

SIM_INLINE struct sim_path sim_path_measure(const struct sim_eye *eye, const double site[3], double sx,
                                            double sy, double x, double y, double n) {
    struct sim_path t;
    double r2 = x * x + y * y, root = sqrt(eye->radius * eye->radius - eye->p * r2);
    double per_root = 1 / root, cube = eye->p * per_root * per_root * per_root;
    t.z = eye->apex - r2 / (eye->radius + root);
    t.zx = -x * per_root;
    t.zy = -y * per_root;
    double ux = x - site[0], uy = y - site[1], uz = t.z - site[2];
    double vx = x - sx, vy = y - sy, vz = t.z - eye->iris_z;
    t.per1 = 1 / sqrt(ux * ux + uy * uy + uz * uz);
    t.per2 = 1 / sqrt(vx * vx + vy * vy + vz * vz);
    t.ux = ux * t.per1;
    t.uy = uy * t.per1;
    t.uz = uz * t.per1;
    t.vx = vx * t.per2;
    t.vy = vy * t.per2;
    t.vz = vz * t.per2;
    double k1 = t.per1, k2 = n * t.per2, bend = t.uz + n * t.vz;
    double ax = t.ux + t.uz * t.zx, ay = t.uy + t.uz * t.zy, bx = t.vx + t.vz * t.zx, by = t.vy + t.vz * t.zy;
    t.gx = ax + n * bx;
    t.gy = ay + n * by;
    t.hxx = (1 + t.zx * t.zx) * (k1 + k2) - ax * ax * k1 - bx * bx * k2 - bend * (per_root + x * x * cube);
    t.hyy = (1 + t.zy * t.zy) * (k1 + k2) - ay * ay * k1 - by * by * k2 - bend * (per_root + y * y * cube);
    t.hxy = t.zx * t.zy * (k1 + k2) - ax * ay * k1 - bx * by * k2 - bend * x * y * cube;
    return t;
}

#endif
