// SPDX-License-Identifier: Apache-2.0
// What every peer is wrapped into.
#ifndef PEER_H
#define PEER_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

// Gaze (azimuth, elevation; degrees) from the PEER_CHANNELS features that the firmware makes of one frame.
// Scaling of the inputs belongs to it and is counted.
void peer_predict(const uint16_t *feature, float *gaze_deg);

#ifdef __cplusplus
}
#endif

#endif
