# SPDX-License-Identifier: Apache-2.0
"""States of one slip, grouped so that one call of sim_c shares its work over pupils and lids."""

import numpy as np

MOST = 32  # SIM_MAX_PUPILS, SIM_MAX_LIDS


class Call:
    """One term for a product of pupils and lids.

    members    numbers of the states; pupil_at, lid_at: where each is in `pupils` and `lids`
    """

    def __init__(self, term, members, pupils, lids, pupil_at, lid_at):
        self.term, self.members, self.pupils, self.lids = term, members, pupils, lids
        self._at = pupil_at, lid_at

    def value(self, scene, azimuth_deg, elevation_deg):
        """The term at one gaze, [member, sensor, emitter]."""
        if self.term == "glint":
            return scene.glint(azimuth_deg, elevation_deg, self.lids)[self._at[1]]
        return scene.smooth(azimuth_deg, elevation_deg, self.pupils, self.lids, self.term)[self._at]


def calls(pupil_mm, lid_opening, members, term):
    """Calls that cover the states `members` (numbers into the two arrays) of one slip."""
    members = np.asarray(members, int)
    if not members.size:
        return []
    pupils_of = {}
    for state in members:
        pupils_of.setdefault(lid_opening[state], set()).add(pupil_mm[state] if term == "iris" else 0.0)
    lids_of = {}
    for lid, pupils in pupils_of.items():
        lids_of.setdefault(tuple(sorted(pupils)), []).append(lid)
    made = []
    for pupils, lids in lids_of.items():
        for i in range(0, len(pupils), MOST):
            for j in range(0, len(lids), MOST):
                made.append(
                    _call(pupil_mm, lid_opening, members, term, pupils[i : i + MOST], lids[j : j + MOST])
                )
    return made


def _call(pupil_mm, lid_opening, members, term, pupils, lids):
    inside = [s for s in members if lid_opening[s] in lids and (term != "iris" or pupil_mm[s] in pupils)]
    pupil_at = [pupils.index(pupil_mm[s]) if term == "iris" else 0 for s in inside]
    lid_at = [lids.index(lid_opening[s]) for s in inside]
    # The others do not see the pupil: any that exists will do.
    values = np.array(pupils if term == "iris" else [pupil_mm[inside[0]]])
    return Call(term, np.array(inside), values, np.array(lids), np.array(pupil_at), np.array(lid_at))
