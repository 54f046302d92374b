# SPDX-License-Identifier: Apache-2.0
"""The exact method of `maps.compute_map`: every term at the fineness that a pilot found sufficient, the slow
ones interpolated between Chebyshev points where that measures well, and the hardest gazes checked afterwards.

Bound     Per term, the worst error seen, at the pilot's gazes and at the hardest gazes of the finished map,
          as a part of what its pair has at most; over all pairs together; times SAFETY; times what each pair
          has at most. Pooling lets 36 pairs' errors at 20 gazes stand for every pair: what one pair's dozen
          gazes missed another's have seen.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from . import mapplan
from .errors import SceneError
from .mapcall import calls
from .mapjudge import bend, counted_pairs, hardest, mean_response, scale_of
from .mapneed import Chosen, hidden_eye, may_see, other_ports
from .scene import Scene

TERMS = ("face", "sclera", "iris", "glint")
SLOW = ("sclera", "iris")
# Part of the tolerance that each term's integration, and each interpolation, may take. They add up as
# independent errors do: sqrt(4 * 0.35^2 + 2 * 0.4^2) = 0.9.
SHARE, SHARE_BETWEEN = 0.35, 0.4
SAFETY = 4.0
PEAK = 6.0  # an error at one gaze may be this many times the tolerance; terms add up
AUDIT_PEAK = 9.0  # a term found further off than this afterwards is made again, finer
FIRST_NODES, MOST_NODES = 13, 193
NEGLIGIBLE = 0.01  # part of the tolerance below which a term of a port is not computed at all
HARDEST = 4  # gazes, of those where an interpolation is likeliest to be wrong, that are checked
WORTH = 0.6  # interpolation is dropped when its points are more than this part of the map's gazes
ROUNDS = 2
LATTICE = 6  # gazes along each axis at which the map is compared with half its fineness
PROGRESS = {"face": 0.02, "sclera": 0.3, "iris": 0.28, "glint": 0.4}  # part of a map's work, roughly


class Making:
    """One map while it is made. Axes in degrees ascending, states as arrays of one length.

    After make(): mean (response), errors {term: worst, as a part of its pair's peak}, rms {term: of the
    mean}, left_out (sentences).
    """

    def __init__(self, headset, person, azimuth_deg, elevation_deg, states, tol, workers, progress):
        self.headset, self.person, self.tol = headset, person, tol
        self.azimuth, self.elevation = azimuth_deg, elevation_deg
        self.pupil, self.lid, self.slip = states
        self.pairs = (len(headset.sensors), len(headset.emitters))
        self.errors, self.rms, self._notes, self._facts = {}, {}, {}, []
        self._workers, self._progress, self._base, self._shown = workers, progress, 0.0, 0.0
        self._between_share = dict.fromkeys(SLOW, SHARE_BETWEEN)
        self._scenes, self._rough = {}, set()

    def run(self, function, items, part=0.0):
        """List of function(item), in threads. part: of the progress that they are together."""
        items, futures = list(items), []
        try:
            futures = [self._pool.submit(function, item) for item in items]
            values = []
            for future in futures:
                values.append(future.result())
                self._shown = max(self._shown, min(0.999, self._base + part * len(values) / len(items)))
                if self._progress:
                    self._progress(self._shown)
            return values
        except BaseException:
            for future in futures:
                future.cancel()
            raise

    def make(self):
        """Parts {term: [state, sensor, emitter, elevation, azimuth]}."""
        with ThreadPoolExecutor(self._workers) as self._pool:
            self._plan()
            parts, wanted = {}, TERMS
            for left in reversed(range(ROUNDS)):
                for term in wanted:
                    parts[term] = self._term(term)
                wanted = self._audit(parts)
                if not wanted or not left:
                    break
                self._refine(wanted)
        for term in SLOW:
            self.rms[term] = float(np.hypot(self.rms[term], self.rms.pop(term + " between", 0.0)))
        dark = 100 * (parts["glint"][self.lid > 0] == 0).mean() if (self.lid > 0).any() else 0.0
        if dark and "no glint" not in self._notes:
            self._notes["unlit"] = (
                "glint: 0 for %.2g %% of pairs and gazes, where nothing of its lobe is in view" % dark
            )
        total = sum(parts.values())
        self.mean = mean_response(np.moveaxis(total, (1, 2), (3, 4)), self.azimuth, self.elevation)
        return {term: np.moveaxis(values, (1, 2), (3, 4)) for term, values in parts.items()}

    def bound(self, parts):
        """Bound of the error at any gaze, [state, sensor, emitter]."""
        worst = {term: self.errors[term] + self.errors.get(term + " between", 0.0) for term in TERMS}
        seen = sum(SAFETY * worst[term] * scale_of(parts[term].max((3, 4))) for term in TERMS)
        return seen + sum(self._unseen.values())

    def _rms(self, error):
        """Over the pairs that count (its last two axes) and everything else."""
        return float(np.sqrt((error[..., counted_pairs(self.pairs)] ** 2).mean()))

    def _keep(self, term, error, peak):
        """Keep the worst error [n, sensor, emitter] of a term as a part of what its pair has at most."""
        worst = float((error / scale_of(peak)).max()) if error.size else 0.0
        self.errors[term] = max(self.errors.get(term, 0.0), worst)

    # fineness ----------------------------------------------------------------------------------------------

    def _plan(self):
        order = np.lexsort((self.pupil, self.lid))
        picked = order[np.linspace(0, len(order) - 1, mapplan.N_PILOT).round().astype(int)]
        picked = picked[(5 * np.arange(len(picked))) % len(picked)]  # a pose with any gaze
        self._middle = self.slip[np.argmin(np.abs(self.slip).sum(1))]
        gazes = mapplan.pilot_gazes(self.azimuth, self.elevation)
        states = [(self.pupil[i], self.lid[i]) for i in picked]
        self.pilot = mapplan.Pilot(self.headset, self.person, self._middle, gazes, states, self.run)
        rough = Scene(self.headset, self.person, self._middle, {"face": 0.35})
        light = self.pilot.of(rough, "face") + sum(self.pilot.value(term, 0) for term in TERMS[1:])
        self.mean = float(light[:, counted_pairs(self.pairs)].mean())
        if not self.mean > 0:
            raise SceneError("no sensor receives any light", "check the aims, and where the eye is")
        self.rung, self.quality = {}, {}
        for term in TERMS[1:]:
            self._settle(term, self.pilot.choose(term, SHARE * self.tol * self.mean, self._rms, PEAK))
        self._permit_mirror()
        self._settle_face(2 if self.tol < 1e-3 else 0)
        self._leave_out()

    def _settle_face(self, start):
        tolerance = SHARE * self.tol * self.mean
        rung, scene, error = self.pilot.choose_face(self.quality, tolerance, self._rms, 1.2 * PEAK, start)
        self.rung["face"], self.quality["face"] = rung, mapplan.fineness("face", rung)
        self._scenes[tuple(self._middle), "", 0] = scene
        self._keep("face", error, self.pilot.value("face", rung).max(0))
        self.rms["face"] = mapplan.RMS_SAFETY * self._rms(error) / self.mean

    def _leave_out(self):
        """Find the ports that provably see nothing of a term."""
        self._chosen, self._unseen = {}, {}
        reach = max(np.abs(self.azimuth).max(), np.abs(self.elevation).max())
        bounds = [
            may_see(self.headset, self.person, s, reach, self.pupil) for s in np.unique(self.slip, axis=0)
        ]
        for term in TERMS[1:]:
            bound = np.max([some[term] for some in bounds], axis=0)
            least = NEGLIGIBLE * self.tol * self.mean
            sensors = np.flatnonzero(bound.max(1) > least)
            emitters = np.flatnonzero(bound.max(0) > least)
            if len(sensors) == bound.shape[0] and len(emitters) == bound.shape[1]:
                continue
            kept = np.zeros(bound.shape, bool)
            kept[np.ix_(sensors, emitters)] = True
            self._chosen[term], self._unseen[term] = (sensors, emitters), np.where(kept, 0.0, bound)
            self._notes["no " + term] = (
                "%s: left out for %s, whose windows show none of it; at most %.0e of the mean"
                % (
                    term,
                    other_ports(self.pairs, sensors, emitters),
                    self._unseen[term].max() / self.mean,
                )
            )

    def _settle(self, term, rung):
        """Take a rung for a term of the eye."""
        self.rung[term], self.quality[term] = rung, mapplan.fineness(term, rung)
        error = self.pilot.error(term, rung)
        self._keep(term, error, np.abs(self.pilot.value(term, rung)).max(0))
        self.rms[term] = mapplan.RMS_SAFETY * self._rms(error) / self.mean

    def _permit_mirror(self):
        """Let mirror points stand in for the lobe where sim_c's own estimate allows it, when the pilot's
        gazes confirm that.
        """
        pilot, rung, share = self.pilot, self.rung["glint"], SHARE * self.tol * self.mean
        if not 0 < share < 1:
            return
        quality = {"glint": self.quality["glint"], "face": mapplan.EYE_ONLY, "tolerance": share}
        value = pilot.of(Scene(self.headset, self.person, self._middle, quality), "glint")
        error = np.abs(value - pilot.value("glint", rung + mapplan.FINER))
        rms = mapplan.RMS_SAFETY * self._rms(error)
        if rms > share or error.max() > PEAK * share or np.array_equal(value, pilot.value("glint", rung)):
            return
        self.quality["tolerance"] = share
        self._keep("glint", error, value.max(0))
        self.rms["glint"] = rms / self.mean
        self._notes["mirror"] = (
            "glint: a mirror point instead of the whole lobe of directions, where the change is estimated "
            "below the tolerance; error %.1e of the mean (rms)" % (rms / self.mean)
        )

    def _refine(self, terms):
        """After an audit that found terms too coarse."""
        for term in terms:
            self.errors.pop(term)
            if term in self._rough:
                self._between_share[term] /= 2
            if term == "glint" and "tolerance" in self.quality:
                del self.quality["tolerance"], self._notes["mirror"]
            else:
                self._settle(term, min(self.rung[term] + 1, mapplan.RUNGS[term][1]))
        self._scenes.clear()

    # terms -------------------------------------------------------------------------------------------------

    def _scene(self, slip, term, rungs=0):
        """The scene for a term at a slip; `rungs` finer (coarser) than what makes the map, for checks."""
        chosen = self._chosen.get(term)
        key = tuple(slip), term if chosen else "", rungs
        if key not in self._scenes:
            quality = dict(self.quality)
            if rungs:
                for name in TERMS[1:]:
                    quality[name] = mapplan.fineness(name, self.rung[name] + rungs)
                quality.update(face=mapplan.EYE_ONLY, tolerance=0.0)
            scene = self.headset, self.person, slip, quality
            self._scenes[key] = Chosen(*scene, *chosen) if chosen else Scene(*scene)
        return self._scenes[key]

    def _term(self, term):
        """[state, elevation, azimuth, sensor, emitter] of a term, at every gaze of the map."""
        out = np.zeros((len(self.pupil), len(self.elevation), len(self.azimuth)) + self.pairs)
        slips = np.unique(self.slip, axis=0)
        self._rough.discard(term)
        for kept in self.errors, self.rms:
            kept.pop(term + " between", None)
        self._notes.pop(term, None)
        if term == "face":  # what the engine says of itself, as far as it is so at every slip
            facts = [self._scene(slip, term).left_out() for slip in slips]
            self._facts = [said for said in facts[0] if all(said in others for others in facts)]
        for slip in slips:
            members = np.flatnonzero((self.slip == slip).all(1))
            if term != "face":
                members = members[self.lid[members] > 0]  # closed lids hide the eye: exactly nothing
            if not all(len(ports) for ports in self._chosen.get(term, [[0]])):
                continue
            groups = calls(self.pupil, self.lid, members, term)
            for call in groups:
                part = PROGRESS[term] / len(slips) / len(groups)
                out[call.members] = self._values(self._scene(slip, term), call, part)
                self._base += part
        return out

    def _values(self, scene, call, part):
        """[member, elevation, azimuth, sensor, emitter] for one call's states."""
        if call.term == "face":  # the same wherever the eye looks sideways
            return self._direct(scene, call, self.elevation, self.azimuth[:1], part)
        made = self._between(scene, call, part) if call.term in SLOW else None
        return self._direct(scene, call, self.elevation, self.azimuth, part) if made is None else made

    def _direct(self, scene, call, elevation, azimuth, part=0.0):
        """A term at every gaze of two axes, [member, elevation, azimuth, sensor, emitter]."""
        gazes = [(a, e) for e in elevation for a in azimuth]
        values = np.concatenate(
            self.run(
                lambda some: np.array([call.value(scene, a, e) for a, e in some]),
                [gazes[i : i + 8] for i in range(0, len(gazes), 8)],
                part,
            )
        )
        shape = (len(elevation), len(azimuth)) + values.shape[1:]
        return np.moveaxis(values.reshape(shape), 2, 0)

    def _between(self, scene, call, part):
        """The same by interpolation between Chebyshev points, halved along the rougher axis until gazes
        between them agree: some anywhere, and those where half the points give something else. None when
        direct evaluation costs less.
        """
        axes = self.elevation, self.azimuth
        count = [1 if len(axis) == 1 else FIRST_NODES for axis in axes]
        limit = WORTH * len(axes[0]) * len(axes[1])
        gazes = mapplan.inner_gazes(self.azimuth, self.elevation)
        tolerance = self._between_share[call.term] * self.tol * self.mean
        truth, known = None, {}
        while count[0] * count[1] <= limit:
            if truth is None:
                truth = np.array(self.run(lambda gaze: call.value(scene, *gaze), gazes))
            nodes = [mapplan.chebyshev_nodes(axis[0], axis[-1], n) for axis, n in zip(axes, count)]
            stride = [1 if n == 1 else (MOST_NODES - 1) // (n - 1) for n in count]
            places = [(i, j) for i in range(count[0]) for j in range(count[1])]
            new = [(i, j) for i, j in places if (i * stride[0], j * stride[1]) not in known]
            values = self.run(
                lambda at: call.value(scene, nodes[1][at[1]], nodes[0][at[0]]), new, part * len(new) / limit
            )
            known.update(((i * stride[0], j * stride[1]), value) for (i, j), value in zip(new, values))
            table = np.array([known[i * stride[0], j * stride[1]] for i, j in places])
            table = table.reshape(tuple(count) + table.shape[1:])
            error = np.abs(mapplan.interpolate_at(table, *nodes, gazes) - truth)
            rms = mapplan.RMS_SAFETY * self._rms(error)
            if rms <= tolerance:
                made, hard = self._interpolated(scene, call, table, nodes)
                if hard.max(initial=0.0) <= tolerance / SHARE_BETWEEN * PEAK / 2:
                    errors = np.concatenate([error.reshape((-1,) + self.pairs), hard])
                    self._keep_between(call, made, errors, nodes, rms)
                    return made
            growable = [i for i in (0, 1) if 1 < count[i] < MOST_NODES]
            if not growable:
                break
            grow = max(growable, key=lambda i: mapplan.tail(table, i))
            count[grow] = 2 * count[grow] - 1
        return None

    def _interpolated(self, scene, call, table, nodes):
        """(the term on the map's grid, its error [n, sensor, emitter] where half the points differ most)."""
        axes = self.elevation, self.azimuth
        step = [1 if len(n) == 1 else 2 for n in nodes]
        half = table[:: step[0], :: step[1]], nodes[0][:: step[0]], nodes[1][:: step[1]]
        made = np.moveaxis(mapplan.interpolate(table, *nodes, *axes), 2, 0)
        coarse = np.moveaxis(mapplan.interpolate(*half, *axes), 2, 0)
        rough = (np.abs(made - coarse) / scale_of(np.abs(made).max((0, 1, 2)))).max((0, 3, 4))
        places = hardest(rough[None], self.azimuth, self.elevation, HARDEST)
        truth = self.run(lambda at: call.value(scene, self.azimuth[at[2]], self.elevation[at[1]]), places)
        error = [np.abs(made[:, at[1], at[2]] - value) for at, value in zip(places, truth)]
        return made, np.array(error).reshape((-1,) + self.pairs)

    def _keep_between(self, call, made, error, nodes, rms):
        term = call.term
        self._rough.add(term)
        self._keep(term + " between", error, np.abs(made).max((0, 1, 2)))
        self.rms[term + " between"] = max(self.rms.get(term + " between", 0.0), rms / self.mean)
        self._notes[term] = (
            "%s: computed at %d x %d gazes (azimuth x elevation) and interpolated; error at gazes between "
            "them %.1e of the mean (rms)" % (term, len(nodes[1]), len(nodes[0]), rms / self.mean)
        )

    # the hardest gazes -------------------------------------------------------------------------------------

    def _audit(self, parts):
        """Compare the map with everything twice as fine where it is likeliest to be wrong: where it bends
        most, and where half the fineness gives something else, on a lattice. Returns the terms whose error at
        a gaze is more than AUDIT_PEAK tolerances and that can be had finer.
        """
        terms = [t for t in TERMS[1:] if all(len(ports) for ports in self._chosen.get(t, [[0]]))]
        chosen, roughness = set(), {}
        lattice = self._lattice()
        coarse = self._at(lattice, terms, -mapplan.FINER)
        for k, term in enumerate(terms):
            scale = scale_of(parts[term].max((0, 1, 2)))
            roughness[term] = rough = (bend(parts[term]) / scale).max((3, 4))
            chosen.update(hardest(rough, self.azimuth, self.elevation, 2 + min(12, len(self.pupil) // 2)))
            off = [(np.abs(v - parts[term][at]) / scale).max() for v, at in zip(coarse[:, k], lattice)]
            chosen.update(lattice[i] for i in np.argsort(off)[-3:])
        chosen = sorted(chosen)
        values = self._at(chosen, terms, mapplan.FINER)
        bad = []
        for k, term in enumerate(terms):
            error = np.array([np.abs(v - parts[term][at]) for v, at in zip(values[:, k], chosen)])
            error = error.reshape((-1,) + self.pairs)
            better = self.rung[term] < mapplan.RUNGS[term][1] or term in self._rough
            if better and error.size and error.max() > AUDIT_PEAK * self.tol * self.mean:
                bad.append(term)
            self._keep(term, error, parts[term].max((0, 1, 2)))
            # The rms over the map, if errors are as the map bends.
            rough = roughness[term]
            here = np.sqrt(np.mean([rough[at] ** 2 for at in chosen])) if chosen else 0.0
            if here > 0:
                rms = mapplan.RMS_SAFETY * self._rms(error) * np.sqrt((rough**2).mean()) / here
                self.rms[term] = max(self.rms[term], float(rms / self.mean))
        return bad

    def _lattice(self):
        """Places (state, row, column) spread over the map, the states in turn."""
        rows, columns = (
            np.unique(np.linspace(0, len(axis) - 1, LATTICE).round().astype(int))
            for axis in (self.elevation, self.azimuth)
        )
        gazes = [(int(row), int(column)) for row in rows for column in columns]
        lit = np.flatnonzero(self.lid > 0)
        return [(int(lit[(5 * k) % len(lit)]),) + gaze for k, gaze in enumerate(gazes)] if len(lit) else []

    def _at(self, places, terms, rungs):
        """Terms at places of the map with another fineness, [place, term, sensor, emitter]."""
        for slip in {tuple(self.slip[place[0]]) for place in places}:
            for term in terms:
                self._scene(slip, term, rungs)

        def one(place):
            state, row, column = place
            gaze = self.azimuth[column], self.elevation[row], self.pupil[state], self.lid[state]
            return [
                mapplan.term_value(self._scene(self.slip[state], term, rungs), term, *gaze) for term in terms
            ]

        return np.array(self.run(one, places)).reshape((len(places), len(terms)) + self.pairs)

    def left_out(self):
        """Sentences on what was left out or simplified, why, and what that costs."""
        said = hidden_eye(self.lid)
        if len(self.azimuth) > 1:
            said.append("face: computed once per elevation, because the lids follow elevation only; error 0")
        said += self._facts
        for name in ("no sclera", "no iris", "no glint", "sclera", "iris", "unlit", "mirror"):
            if name in self._notes:
                said.append(self._notes[name])
        for term in TERMS:
            said.append(
                "%s: integrated at fineness %.2g; error %.1e of the mean (rms)"
                % (term, self.quality[term], self.rms[term])
            )
        return said
