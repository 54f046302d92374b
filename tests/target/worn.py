# SPDX-License-Identifier: Apache-2.0
"""A headset on a still simulated person: the whole firmware, calibrated once, its stream beside the truth."""

import numpy as np

from sparsegaze import calibrate, linearity, metrics
from sparsegaze.device import Device
from sparsegaze.screen import VirtualScreen
from sparsegaze.virtual import VirtualNano
from sparsegaze.wire import lib

PERSON = 1              # of headsets/led2gaze.toml: its response map is computed once and kept
TARGETS, VECTORS = 50, 15
CYCLES_PER_US = 16
WILD_DEG = 5.0          # off the truth while called valid: no error of a calibration reaches that
GOOD_DEG = 1.5          # mean, of a calibration on so few targets
LIGHT = lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED
NAMES = {name: getattr(lib, f"SG_FLAG_{name.upper()}")
         for name in ("out_of_range", "saturated", "starved", "exposure", "fault", "recovering")}
PLACES = ((0.0, 0.0), (9.0, -6.0))


def calibrated(folder, elf):
    """A state folder (flash, EEPROM) of the firmware `elf` with a model of PERSON; tried once a `folder`."""
    done, state = folder / "worn", folder / "worn-part"
    if not done.is_dir():
        assert not state.exists(), "the calibration failed before: see the first test that needed it"
        with VirtualNano(person=PERSON, unpaced=True, app=elf, state_dir=state) as nano:
            with Device(nano.port) as device:
                nano.control.motion(False)
                linearity.run(device)
                device.link.sleep(0.5)
            nano.control.motion(True)
            calibrate.run(nano.port, n_targets=TARGETS, vectors=VECTORS, n_validation=0)
        state.rename(done)
    return done


class Worn:
    """A VirtualNano and the Device on it, in lockstep; the eye is where it is told to be, and still."""

    def __init__(self, nano, device):
        self.nano, self.device, self.control = nano, device, nano.control
        screen = VirtualScreen(self.control)
        screen.open(device)
        self.offset_us = screen.offset_us       # device time minus the virtual Nano's
        self.control.motion(False)
        self.control.follow(False)
        self.at = PLACES[0]
        self.look(self.at)

    def look(self, place):
        self.control.targets_clear()
        self.control.target(self.now_us(), *place)
        self.at = place

    def now_us(self):
        """Virtual time."""
        return self.control.time().us

    def run(self, seconds, raw=False, counts=False):
        """Frames of so much device time from now on, a list of Frame."""
        self.device.set_stream(gaze=True, raw=raw, counts=counts)
        begin, found = self.now_us() + self.offset_us, []
        for frame in self.device.frames(5.0):
            if frame.t_us >= begin:
                found.append(frame)
                if frame.t_us >= begin + seconds * 1e6:
                    return found
        raise AssertionError("the stream ended")

    def settle(self, seconds=0.4):
        """Exposures, and all that is averaged, come to rest; nothing is looked at."""
        self.device.link.sleep(seconds)

    def error(self, frames):
        """[n] degrees between each valid gaze and where the eye looks, nan where it is not called valid."""
        gaze = np.array([(f.gaze.azimuth_deg, f.gaze.elevation_deg) for f in frames])
        truth = np.broadcast_to(self.at, gaze.shape)
        return np.where([f.gaze.valid for f in frames], metrics.frame_errors_deg(*gaze.T, *truth.T), np.nan)

    def never_wild(self, frames, what=""):
        """Asserts what every hard case must keep. Returns the share of valid frames."""
        error = self.error(frames)
        valid = np.isfinite(error)
        worst = error[valid].max(initial=0.0)
        named = {name: round(float((flags(frames) & bit != 0).mean()), 3) for name, bit in NAMES.items()}
        print(f"{what}: {valid.mean():.3f} of {len(frames)} valid, worst of them {worst:.2f} deg off,"
              f" {int((error > WILD_DEG).sum())} wild; {({k: v for k, v in named.items() if v})}")
        assert worst <= WILD_DEG
        return valid.mean()

    def good(self, frames, what="", least=1.0, limit_deg=GOOD_DEG):
        """Asserts a gaze, near the truth. Returns its mean error, degrees."""
        self.never_wild(frames, what)
        error = self.error(frames)
        assert np.isfinite(error).mean() >= least, what
        print(f"{what}: mean error {np.nanmean(error):.3f} deg")
        assert np.nanmean(error) <= limit_deg
        return np.nanmean(error)

    def times(self, frames):
        """[n] virtual time of each frame, us."""
        return np.array([frame.t_us for frame in frames]) - self.offset_us


def flags(frames):
    """[n] of the gaze frames."""
    return np.array([frame.gaze.flags for frame in frames])


def gazes(frames):
    """[n, 2] degrees, valid or not."""
    return np.array([(frame.gaze.azimuth_deg, frame.gaze.elevation_deg) for frame in frames])


def features(frames):
    """[n, 6] float64, of raw frames."""
    return np.array([frame.raw.feature for frame in frames], float)


def jitter(values):
    """RMS from one to the next of [n, ...] over sqrt 2: what settles or drifts is slower."""
    return np.diff(values, axis=0).std(axis=0) / np.sqrt(2)
