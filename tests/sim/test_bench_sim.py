# SPDX-License-Identifier: Apache-2.0
"""The benchmark's report has the keys and the arithmetic that readers rely on. Neither Mitsuba nor a long
run."""

import json
import sys

import numpy as np
import pytest
from sim_scenes import pair, port


@pytest.fixture(scope="module")
def bench(bench_modules):
    """The benchmark's modules, by name."""
    names = (
        "bench_cost",
        "bench_errors",
        "bench_peers",
        "bench_sim",
        "error_curve",
        "mitsuba_peer",
        "peer_scene",
    )
    return vars(bench_modules(**{name: name for name in names}))


@pytest.fixture(scope="module")
def ring_report(bench, tmp_path_factory):
    """sim.json of a run of the quickest section alone."""
    folder = tmp_path_factory.mktemp("bench")
    argv, sys.argv = sys.argv, ["bench_sim.py", "--quick", "--only", "ring", "--out", str(folder)]
    try:
        assert bench["bench_sim"].main() == 0
    finally:
        sys.argv = argv
    assert (folder / "sim.png").stat().st_size > 20_000
    return json.loads((folder / "sim.json").read_text())


def test_the_ring_has_its_keys_and_is_sharper_than_a_hard_crease(ring_report):
    ring = ring_report["ring"]
    assert {"peak_deg", "peak_over_median", "fwhm_deg", "hard_crease_peak_over_median"} <= set(ring)
    assert ring["peak_over_median"] > ring["hard_crease_peak_over_median"] > 1
    assert len(ring["azimuth_deg"]) == len(ring["glint_over_median"])
    assert max(ring["glint_over_median"]) == pytest.approx(ring["peak_over_median"])


def test_sections_that_were_not_run_leave_no_figures_and_no_bars(ring_report):
    assert not {"scenes", "speed", "offgrid", "peers", "scaling"} & set(ring_report)
    assert ring_report["bars"] == [] and ring_report["quick"] is True
    assert ring_report["machine"]["cores"] >= 1


def judged(bench, error, bound, doubt=0.0):
    truth = {term: np.full((2, 3), 1.0) for term in ("face", "sclera", "iris", "glint")}
    got = {term: values.copy() for term, values in truth.items()}
    got["glint"][0, 1] += error
    got["iris"][1, 2] -= 2 * error
    full = np.full((2, 3), 1.0)
    return bench["bench_errors"].judge("two", got, truth, bound * full, doubt * full, 2.0)


def test_a_scene_is_judged_term_by_term_in_parts_of_the_mean(bench):
    row = judged(bench, 1e-3, 3e-3)
    assert row["rms_glint"] == pytest.approx(0.5e-3 / np.sqrt(6))
    assert row["rms_diffuse"] == pytest.approx(1e-3 / np.sqrt(6))
    assert row["rms_total"] == pytest.approx(np.sqrt((0.25 + 1) / 6) * 1e-3)
    assert row["max_total"] == pytest.approx(1e-3)
    assert (row["states"], row["pairs"], row["name"]) == (2, 3, "two")


def test_a_bound_must_exceed_every_error_but_not_the_references_own(bench):
    assert judged(bench, 1e-3, 2.1e-3)["estimate_bounds"] is True
    assert judged(bench, 1e-3, 1.9e-3)["estimate_bounds"] is False
    assert judged(bench, 1e-3, 1.9e-3, doubt=0.2e-3)["estimate_bounds"] is True


def test_a_real_scene_gives_every_key(bench):
    from random_scenes import Case

    from sparsegaze.person import nominal_person

    ends = [port(place, (0, 0, -11), 10.0, 1.5) for place in ((14, -8, -28), (-12, -10, -31))]
    case = Case("one pair", pair(*ends), nominal_person(), ((3.0, -2.0, 3.5, 1.0),))
    row = bench["bench_errors"].scene_row(case, bench["bench_errors"].reference_of(case), 1)
    wanted = {"name", "rms_total", "rms_diffuse", "rms_glint", "max_total", "estimate_bounds", "seconds"}
    assert wanted <= set(row)
    assert 0 < row["rms_total"] < 1e-2 and row["seconds"] > 0


def test_seconds_at_an_error_are_read_between_and_beyond_settings(bench):
    seconds_at = bench["error_curve"].seconds_at
    points = [(1.0, 1e-2), (4.0, 5e-3), (2.0, 2e-2), (16.0, 2.5e-3)]  # the third is beaten by the first
    assert bench["error_curve"].frontier(points) == [(1.0, 1e-2), (4.0, 5e-3), (16.0, 2.5e-3)]
    assert seconds_at(points, 5e-3) == (pytest.approx(4.0), "between")
    assert seconds_at(points, 1e-2 / np.sqrt(2)) == (pytest.approx(2.0), "between")
    assert seconds_at(points, 1.25e-3) == (pytest.approx(64.0), "beyond")
    assert seconds_at(points, 0.5) == (1.0, "cheapest")
    assert seconds_at([(3.0, 1e-2)], 1e-3) == (pytest.approx(300.0), "beyond")


def test_peers_are_compared_at_equal_error(bench):
    rows = {
        "sparsegaze": [{"seconds": 1e-5, "rms": 1e-3}, {"seconds": 2e-5, "rms": 1e-4}],
        "image method": [{"seconds": 1e-2, "rms": 2e-3}, {"seconds": 4e-2, "rms": 1e-3}],
        "Mitsuba 3 llvm_ad_mono": [{"seconds": 0.1, "rms": 2e-3}, {"seconds": 0.4, "rms": 1e-3}],
    }
    made = bench["bench_peers"].compare(rows, {"mitsuba": "3.9.1", "sparsegaze": "0.3"})
    by_name = {row["name"]: row for row in made["peers"]}
    assert by_name["Mitsuba 3 llvm_ad_mono"]["version"] == "3.9.1"
    for row in made["peers"]:
        assert {"name", "version", "seconds_per_response", "rms"} <= set(row) and row["rms"] == 1e-3
    assert by_name["image method"]["times_ours"] == pytest.approx(4000)
    assert by_name["Mitsuba 3 llvm_ad_mono"]["times_ours"] == pytest.approx(40000)
    assert by_name["Mitsuba 3 llvm_ad_mono"]["times_ours_at_our_best"] == pytest.approx(0.4 * 100 / 2e-5)


def test_scaling_is_measured_along_gazes_and_along_pairs(bench):
    rows = [
        dict(
            grid=g, leds=n, seconds=1e-5 * g * g * n * (n - 1), peak_mb=90 + g * g / 100, base_mb=90, map_mb=2
        )
        for g, n in ((11, 6), (21, 6), (41, 6), (21, 3), (21, 9))
    ]
    made = bench["bench_cost"].scaling_figures(rows)
    assert made["gazes"] == [121, 441, 1681, 441, 441] and made["pairs"] == [30, 30, 30, 6, 72]
    assert len(made["seconds"]) == len(made["peak_mb"]) == 5
    assert made["exponent_gazes"] == pytest.approx(1) and made["exponent_pairs"] == pytest.approx(1)


def test_images_tend_to_the_truth_that_they_approach_quadratically(bench):
    sizes = (64, 128, 256)
    ours = np.array([[2.0, 1.0], [3.0, 2.0]])
    theirs = ours[:, None] + 40.0 / np.array(sizes)[None, :, None] ** 2
    made = bench["bench_errors"].judge_images(ours, theirs, sizes)
    assert made["order"] == pytest.approx(2) and made["extrapolated_rms"] < 1e-12
    assert made["rms"][0] == pytest.approx(40 / 64**2 / 2)


def test_a_missed_bar_fails_the_run_and_a_missed_aim_does_not(bench, capsys, tmp_path):
    report = {
        "peers": [dict(name="Mitsuba 3 " + kind, times_ours=9e3) for kind in "ab"],
        "agreement": {"total": {"rms": 2e-4}},
        "seconds": 1.0,
    }
    report["bars"] = bench["bench_sim"].bars(report)
    assert [row["met"] for row in report["bars"]] == [True, True, False, False]
    assert bench["bench_sim"].tell(report, tmp_path) == 0
    report["agreement"]["total"]["rms"] = 2e-3
    report["bars"] = bench["bench_sim"].bars(report)
    assert bench["bench_sim"].tell(report, tmp_path) == 1
    assert "agreement with Mitsuba" in capsys.readouterr().err


def test_without_mitsuba_the_reason_is_said(bench, monkeypatch, tmp_path):
    monkeypatch.setattr(bench["bench_peers"], "PYTHON", tmp_path / "python")
    assert "setup_bench.sh" in bench["bench_peers"].missing()


# The peers' scenes
# -------------------------------------------------------------------------------------------


def test_the_peers_mesh_is_the_eye(bench):
    scene = bench["peer_scene"]
    mesh = scene.eye_mesh(scene.EYE_PERSON, 60, 80)
    p = mesh["vertex"][mesh["triangle"]]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (normal * p.mean(1)).sum(1).min() > 0, "every triangle has an area and faces out"
    np.testing.assert_allclose(np.linalg.norm(mesh["normal"], axis=1), 1, atol=1e-12)
    flat = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    assert (flat * mesh["normal"][mesh["triangle"][:, 0]]).sum(1).min() > 0.99
    edges = np.sort(np.concatenate([mesh["triangle"][:, k] for k in ([0, 1], [1, 2], [2, 0])]), 1)
    _, times = np.unique(edges[edges.min(1) >= 80], axis=0, return_counts=True)
    assert times.max() == 2
    assert mesh["albedo"][0] == 0 and mesh["albedo"][-1] == scene.EYE_PERSON.albedo_sclera


def test_the_peers_mesh_is_the_face(bench):
    scene = bench["peer_scene"]
    mesh = scene.face_mesh(scene.FACE_PERSON, 4.0)
    p = mesh["vertex"][mesh["triangle"]]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (normal[:, 2] < 0).all(), "every triangle faces forward"
    assert normal[:, 2].sum() / 2 == pytest.approx(-64 * 64)


def test_an_eye_that_looks_straight_ahead_has_its_axis_at_kappa(bench):
    scene, person = bench["peer_scene"], bench["peer_scene"].EYE_PERSON
    ahead = scene.direction(person.kappa_azimuth_deg, person.kappa_elevation_deg)
    axes = scene.eye_axes(person, 0.0, 0.0)
    np.testing.assert_allclose(axes[:, 2], ahead, atol=1e-12)
    for gaze in ((20.0, 0.0), (-12.0, 17.0)):
        axes = scene.eye_axes(person, *gaze)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        turned = np.degrees(np.arccos(scene.direction(*gaze) @ axes[:, 2]))
        kappa = np.degrees(np.arccos(scene.direction(0, 0) @ ahead))
        assert turned == pytest.approx(kappa, abs=1e-9), "kappa turns with the eye"


def test_a_peers_pixels_weigh_what_the_window_lets_through(bench):
    """Summed over all pixels: the integral of the window over solid angle, which has no closed form."""
    tangent = np.tan(np.radians(8.5))
    angle = np.linspace(0, np.arctan(4.5 * tangent), 200_001)
    ring = np.exp(-np.tan(angle) ** 2 / (2 * tangent**2)) * 2 * np.pi * np.sin(angle)
    exact = ((ring[1:] + ring[:-1]) / 2).sum() * (angle[1] - angle[0])
    got = [bench["mitsuba_peer"].pixel_weights(n, tangent).sum() for n in (16, 64)]
    # the square's corners lie outside the circle that was integrated: 4e-5
    assert got == pytest.approx([exact, exact], rel=6e-5)


def test_what_the_peers_need_is_pinned_with_hashes_and_named_nowhere_else(repo_root):
    wanted = [
        line for line in (repo_root / "requirements-bench.in").read_text().splitlines() if line[:1].isalpha()
    ]
    locked = (repo_root / "requirements-bench.txt").read_text().replace("\\\n", " ").splitlines()
    pins = {line.split()[0]: line.count("--hash=sha256:") for line in locked if line[:1].isalpha()}
    assert set(wanted) <= set(pins) and min(pins.values()) > 0
    for name in ("requirements.in", "requirements.txt", "pyproject.toml"):
        assert "mitsuba" not in (repo_root / name).read_text()
    for name in ("requirements-bench.in", "requirements-bench.txt", "tools/bench/setup_bench.sh"):
        assert "://" not in (repo_root / name).read_text()


def test_a_scene_that_fails_is_a_row_and_the_others_are_judged(bench, monkeypatch):
    errors, said = bench["bench_errors"], []
    real = errors.scene_row

    def row(case, truth, threads):
        if case.name == "glint on the limbus":
            raise RuntimeError("no answer")
        return real(case, truth, threads)

    monkeypatch.setattr(errors, "scene_row", row)
    first, second = errors.scenes(2, 1, said.append)
    assert first["failed"] == "RuntimeError: no answer" and first["estimate_bounds"] is False
    assert first["rms_total"] == 1.0 and second["estimate_bounds"] is True and second["rms_total"] < 1e-4
    assert any("glint on the limbus failed" in line for line in said)
    bars = {bar["name"]: bar["met"] for bar in bench["bench_sim"].bars({"scenes": [first, second]})}
    assert not any(bars.values())
