# SPDX-License-Identifier: Apache-2.0
"""From a recording to the model that a device carries: full process (process.py), few vectors (distil.py).

How many vectors is the caller's wish or choose.py's; frames that neither was made from judge the result.
"""

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from . import choose, trustfit
from .distil import DistilReport, distil
from .gp import GaussianProcess
from .model import DeviceModel
from .process import fit_process, thin

HELD_OUT_MAX, HELD_OUT_LEAST = 2000, 100  # frames to judge a model on
CLOUD_EACH = 50  # frames of each fixation that the model has to be good at


@dataclass(frozen=True)
class FitResult:
    """What fit_recording made: gp GaussianProcess, model DeviceModel, report FitReport."""

    gp: GaussianProcess
    model: DeviceModel
    report: "FitReport"


@dataclass(frozen=True)
class FitReport:
    """How a recording became a model.

    fixations, frames used; rejected_frames (blinks) and outliers (targets [m, 2] that contradict all others)
    loo_rms_deg, loo_mean_deg  leave-one-fixation-out error of the fixations' means
    lml, condition, jitter  of the process on the means, whose likelihood was maximised
    length [d] feature units, signal_deg, noise_deg; dropped_channels
    aim_deg  rms distance that chose the number of vectors, or None;  cycles on the Nano
    held_out_rows, rms_to_gp_deg, max_to_gp_deg  distance of the device's gaze from the full process's on
    frames that neither process nor model was made from; where there are none (one frame a target), on likely
    inputs
    distil: DistilReport
    """

    fixations: int
    frames: int
    rejected_frames: int
    outliers: list
    loo_rms_deg: float
    loo_mean_deg: float
    lml: float
    condition: float
    jitter: float
    length: list
    signal_deg: float
    noise_deg: float
    dropped_channels: tuple
    aim_deg: float
    cycles: int
    held_out_rows: int
    rms_to_gp_deg: float
    max_to_gp_deg: float
    distil: DistilReport


@threadpool_limits.wrap(limits=1, user_api="blas")  # the matrices are small: threads cost 20 times their gain
def fit_recording(
    recording, n_vectors=None, seed=0, kernel="rbf", p=None, budget_cycles=None, progress=None, rate_hz=None
):
    """Recording -> FitResult. Raises RecordingError, CalibrationError or ModelError; warns of channels it
    drops and of a recording that hardly depends on its targets.

    n_vectors      None chooses: choose.py
    kernel, p      of the full process, see kernels.kernel;  budget_cycles  most that an inference may take
    progress       called as progress(stage, done, total)
    rate_hz        that the Nano is to reach with the gaze streamed: as many vectors as leave it the time
    """
    say = (lambda part: progress("fit", round(100 * part), 100)) if progress else (lambda part: None)
    say(0.0)
    most = choose.most_vectors(budget_cycles, n_vectors, rate_hz)
    process = fit_process(recording, seed, kernel, p)
    say(0.2)
    aim_deg = None if n_vectors else choose.aim_deg(process.loo_rms_deg, budget_cycles, rate_hz)
    fixed, learnt = process.fixed, process.learnt
    rows = fixed.frames(CLOUD_EACH)
    features = fixed.features[rows]
    sigma_deg = trustfit.spread(learnt, process.gp, fixed, rows, process.gp.predict(features))
    model, report = distil(
        process.gp,
        features,
        fixed.target_deg[rows],
        most,
        seed,
        fixed.noise,
        None,
        aim_deg,
        sigma_deg,
        fixed.label[rows],
        lambda part: say(0.2 + 0.8 * part),
    )
    unseen = np.setdiff1d(np.arange(len(fixed.features)), np.union1d(rows, process.rows))
    unseen = fixed.features[thin(unseen, HELD_OUT_MAX)]
    distance = report.rms_deg, report.max_deg
    if len(unseen) >= HELD_OUT_LEAST:
        gaze = np.stack(model.predict(unseen.astype(np.uint16))[:2], axis=1)
        miss = np.linalg.norm(gaze - process.gp.predict(unseen), axis=1)
        distance = float(np.sqrt(np.mean(miss**2))), float(miss.max())
    say(1.0)
    return FitResult(
        process.gp,
        model,
        FitReport(
            len(fixed.mean),
            len(fixed.features),
            fixed.rejected,
            process.outliers,
            process.loo_rms_deg,
            process.loo_mean_deg,
            learnt.lml,
            learnt.condition,
            learnt.jitter,
            [float(v) for v in learnt.hyper.length],
            learnt.hyper.signal_deg,
            learnt.hyper.noise_deg,
            learnt.dropped,
            aim_deg,
            choose.cycles(model.vectors),
            len(unseen) if len(unseen) >= HELD_OUT_LEAST else 0,
            *distance,
            report,
        ),
    )
