# SPDX-License-Identifier: Apache-2.0
"""The paper's way, image times window, summed, against the integrals; and what it gets wrong."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from sim_scenes import pair, port

from sparsegaze import osmesa
from sparsegaze.errors import SceneError
from sparsegaze.image import PARTS, ImageMethod, expose, image_response, view
from sparsegaze.person import draw_person, nominal_person
from sparsegaze.scene import Scene, simulator

# A pinhole has no lens: all lenses are points here, so that both ways mean the same.
SENSOR = port((3.87, -15.52, -28.0), (7.5, 1.5, -11.0), 8.5, 0.0)
EMITTER = port((14.62, -6.51, -28.0), (1.5, -6.5, -11.0), 8.5, 0.0)
HEADSET = pair(SENSOR, EMITTER)
PERSON = replace(nominal_person(), roughness=0.05)
GAZES = [(0, 0), (10, -5), (-12, 8), (20, -15), (5, 17)]
FINE = dict(sclera=3, iris=2, glint=2)
STATE = (0, 0, 3.5, 1.0)


def direct(scene, part, gaze, pupil_mm=3.5, lids=1.0):
    """[sensor, emitter] of one part by the integrals."""
    return scene.glint(*gaze, lids)[0] if part == "glint" else scene.smooth(*gaze, pupil_mm, lids, part)[0, 0]


def errors(part, pixels, gazes=GAZES, person=PERSON, headset=HEADSET, **options):
    """Image less integral of one part, of the mean total over these gazes: [gaze]."""
    scene = Scene(headset, person, quality=FINE)
    method = ImageMethod(headset, person, pixels=pixels, half_width_sigmas=5.0, **options)
    mean = np.mean([scene.response(*gaze) for gaze in gazes])
    return np.array(
        [(method.response(*gaze, parts=(part,)) - direct(scene, part, gaze))[0, 0] / mean for gaze in gazes]
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# Against the integrals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("part, bar", [("face", 1e-5), ("sclera", 2e-5), ("iris", 2e-4), ("glint", 1e-6)])
def test_more_pixels_come_closer_to_the_integral(part, bar):
    # Measured at 384: face 2e-6, sclera 4e-6, iris 6e-5 (its pupil falls between pixels), glint 3e-8.
    coarse, fine = rms(errors(part, 48)), rms(errors(part, 384))
    assert fine < bar and fine < coarse / 10


def test_a_row_of_resolutions_extrapolates_the_iris_to_the_integral():
    # What one image errs at the pupil's edge is chance; over many images it falls as 1 / N^1.5, and the line
    # through that meets zero at the integral.
    pixels = np.arange(96, 225, 8)
    measured = np.array([errors("iris", n, GAZES[:1])[0] for n in pixels])
    _, limit = np.polyfit(pixels**-1.5, measured, 1)
    assert abs(limit) < 1e-4 and rms(measured[:5]) > 1.5 * abs(limit)


def test_shadows_of_the_face_converge_to_the_horizons():
    # A lamp beside the nose, a sensor below it: one sees what the other cannot. Measured 3e-4 at 512.
    headset = pair(
        port((-3.87, -15.52, -28.0), (-4.5, 1.5, -11.0), 8.5, 0.0),
        port((-15.99, 0.56, -28.0), (-1.5, 4.5, -11.0), 8.5, 0.0),
    )
    coarse, fine = (abs(errors("face", n, GAZES[:1], headset=headset)[0]) for n in (64, 512))
    assert fine < 6e-4 and fine < coarse / 5


def test_the_whole_headset_comes_within_a_thousandth(led2gaze):
    # With the real lenses, which a pinhole has not: the skin's horizon is where it shows.
    person, gaze = nominal_person(), (6, -4)
    image = image_response(led2gaze, person, *gaze, pixels=256, half_width_sigmas=5.0)
    other = ~np.eye(6, dtype=bool)
    integral = Scene(led2gaze, person).response(*gaze)
    difference = (image - integral)[other] / integral[other].mean()
    assert rms(difference) < 3e-3 and abs(difference.mean()) < 1e-3


@pytest.mark.parametrize("seed", [3, 11])
@pytest.mark.parametrize("lids", [1.0, 0.5, 0.0])
def test_drawn_persons_with_lids_from_open_to_closed(seed, lids):
    person = replace(draw_person(seed), roughness=0.05)
    scene = Scene(HEADSET, person, quality=FINE)
    method = ImageMethod(HEADSET, person, pixels=256, half_width_sigmas=5.0)
    image = method.response(8, -6, 4.2, lids)[0, 0]
    integral = sum(direct(scene, part, (8, -6), 4.2, lids)[0, 0] for part in PARTS)
    assert image == pytest.approx(integral, rel=5e-4)


def test_what_lies_beyond_the_border_is_missing():
    whole = ImageMethod(HEADSET, PERSON, pixels=250, half_width_sigmas=5.0).response(*STATE)[0, 0]
    lost = []
    for sigmas in (2, 3, 4):
        method = ImageMethod(HEADSET, PERSON, pixels=50 * sigmas, half_width_sigmas=float(sigmas))
        lost.append(1 - method.response(*STATE)[0, 0] / whole)
    assert lost[0] > 0.05 and 1e-3 < lost[1] < 0.02 and lost[2] < 1e-3


def test_the_plain_sum_weighs_the_corners_more_than_their_solid_angle():
    method = ImageMethod(HEADSET, PERSON, pixels=64)
    plain, solid = method.response(*STATE, cos3=False)[0, 0], method.response(*STATE)[0, 0]
    assert 1.05 < plain / solid < 1.3  # measured 1.13


# What the paper warns of ----------------------------------------------------------------------------------


def test_a_clipped_8_bit_image_loses_the_glint_and_16_bits_unclipped_do_not():
    method = ImageMethod(HEADSET, nominal_person(), pixels=128)
    whole, glint = method.response(*STATE)[0, 0], method.response(*STATE, parts=("glint",))[0, 0]
    clipped = method.response(*STATE, bits=8, clip=True)[0, 0]
    deep = method.response(*STATE, bits=16)[0, 0]
    assert glint / whole > 0.1
    assert (whole - clipped) / glint > 0.8  # measured 0.90: nine tenths of the glint are gone
    assert abs(whole - deep) / glint < 1e-3


def test_an_unclipped_8_bit_image_loses_the_dim_part_instead():
    method = ImageMethod(HEADSET, nominal_person(), pixels=128)
    dim = np.array([method.response(*STATE, bits=bits)[0, 0] for bits in ("float", 16, 8)])
    assert 1 - dim[2] / dim[0] > 0.02 and abs(1 - dim[1] / dim[0]) < 2e-4  # measured 0.06, 6e-5


def test_a_glint_narrower_than_five_pixels_aliases():
    """Pixel pitch of 0.2 of the lobe's width: 4e-6 rms; 0.8: a third of the glint, by chance more or less."""
    person = replace(nominal_person(), roughness=0.02)
    gazes = np.random.default_rng(1).uniform(-12, 12, (12, 2))
    scene = Scene(HEADSET, person, quality=FINE)
    exact = np.array([scene.glint(*gaze, 1.0)[0, 0, 0] for gaze in gazes])
    found = {}
    for part_of_lobe in (0.2, 0.8):
        pixels = int(np.ceil(8 * np.tan(np.radians(8.5)) / (part_of_lobe * person.roughness)))
        method = ImageMethod(HEADSET, person, pixels=pixels)
        image = [method.response(*gaze, parts=("glint",))[0, 0] for gaze in gazes]
        found[part_of_lobe] = rms((image - exact) / exact.mean())
    assert found[0.2] < 1e-4 and 0.1 < found[0.8] < 1


@pytest.mark.parametrize("bits, levels", [(8, 255), (16, 65535)])
def test_exposure_has_so_many_levels_and_clips_only_when_asked(bits, levels):
    image = np.append(np.linspace(0, 1, 4001), 100.0)
    seen = expose(image, bits)
    assert seen.max() == 100 and np.allclose(seen * levels / 100 % 1, 0, atol=1e-6)
    assert np.abs(seen - image).max() <= 100 / levels / 2 * (1 + 1e-9)
    clipped = expose(image, bits, clip=True)
    assert clipped.max() == pytest.approx(np.quantile(image[image > 0], 0.99) / 0.8) and clipped.max() < 2
    assert np.array_equal(expose(np.zeros(9), bits, clip=True), np.zeros(9))


# What hides what ------------------------------------------------------------------------------------------


def test_soft_horizons_against_cast_rays(led2gaze):
    """Softening shadows by the lens changes the face's term by 1e-3 of the total, the eye's by less."""
    person = nominal_person()
    soft, rays = (
        ImageMethod(led2gaze, person, pixels=96, half_width_sigmas=5.0, occlusion=kind)
        for kind in ("soft", "rays")
    )
    other = ~np.eye(6, dtype=bool)
    mean = Scene(led2gaze, person).response(10, -5)[other].mean()
    for part, bar in [("face", 4e-3), ("sclera", 1e-3), ("iris", 1e-9), ("glint", 1e-9)]:
        change = (rays.response(10, -5, parts=(part,)) - soft.response(10, -5, parts=(part,)))[other] / mean
        assert rms(change) < bar, part
    face = (rays.response(10, -5, parts=("face",)) - soft.response(10, -5, parts=("face",)))[other] / mean
    assert rms(face) > 1e-6, "rays were cast"


def test_the_cornea_hides_the_sclera_behind_it():
    """Past the rim of a sharp, steep cornea: the soft bulge hides what rays find hidden, to 0.5 % of it."""
    angle = np.radians(24)
    sensor = port((32 * np.sin(angle), 0.0, -32 * np.cos(angle)), (-6.0, 0.0, -10.3), 3.0, 0.0)
    headset = pair(sensor, port((-8.0, -2.0, -40.0), (-6.0, 0.0, -11.0), 25.0, 0.0))
    steep = dict(cornea_radius_mm=7.1, cornea_asphericity=0.0, limbus_blend_mm=0.05, limbus_haze_mm=0.05)
    ahead = dict(kappa_azimuth_deg=0.0, kappa_elevation_deg=0.0, nose_mm=0.0, cheek_mm=0.0, brow_mm=0.0)
    no_lids = dict(lid_upper_deg=58.0, lid_lower_deg=-58.0, canthus_deg=84.0, lid_thickness_mm=0.0)
    person = replace(nominal_person(), **steep, **ahead, **no_lids)
    soft, rays = (
        ImageMethod(headset, person, pixels=256, half_width_sigmas=3.0, occlusion=kind)
        .camera(0)
        .render(0, 0, 3.5, 1.0, ("sclera",))[0]
        for kind in ("soft", "rays")
    )
    assert rays.sum() == pytest.approx(soft.sum(), rel=5e-3)  # measured 2e-3
    assert np.abs(rays - soft).max() > 0.2 * soft.max(), "the cornea's rim is in the picture, and soft"


# float32 against float64 ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def both():
    """{renderer: {part: [emitter, row, column]}} of one view with skin, both lids, glint, iris and sclera."""
    person = draw_person(5)
    return {
        name: ImageMethod(HEADSET, person, pixels=160, renderer=name).camera(0).render_parts(7, -4, 3.1, 0.9)
        for name in ("embree", "osmesa")
    }


@pytest.mark.parametrize("part, bar", [("face", 2e-5), ("sclera", 5e-6), ("iris", 5e-6), ("glint", 5e-6)])
def test_float32_against_float64(both, part, bar):
    """Part of the sum: measured face 3e-6, sclera 2e-7, iris 4e-7, glint 1e-7."""
    exact, single = both["embree"][part], both["osmesa"][part]
    total = sum(image.sum() for image in both["embree"].values())
    assert exact.sum() > 0.005 * total, "there is something to compare"
    assert abs(single.sum(dtype=float) - exact.sum()) < bar * total
    # Pixelwise: a silhouette may fall to either side of a pixel's centre, nothing else may differ.
    off = np.abs(single - exact) > 1e-3 * exact.max()
    assert off.mean() < 2e-4


def test_the_framebuffer_does_not_clamp(both):
    # It holds the radiance times 1e6, so anything that clamps at 1 would cut off most of the picture.
    for part, image in both["osmesa"].items():
        assert image.max() * 1e6 > 10, part
        assert image.max() == pytest.approx(both["embree"][part].max(), rel=1e-3)


def test_float32_half_a_metre_away():
    person = replace(nominal_person(), roughness=0.05)
    sensor = port((60.0, -90.0, -490.0), (0, 0, -11.0), 1.5, 0.0)
    headset = pair(sensor, port((-60.0, -80.0, -480.0), (0, 0, -11.0), 4.0, 0.0))
    found = {
        name: ImageMethod(headset, person, pixels=96, renderer=name).response(5, -8)[0, 0]
        for name in ("embree", "osmesa")
    }
    assert found["osmesa"] == pytest.approx(found["embree"], rel=2e-4)


def test_osmesa_from_two_threads_draws_the_same():
    method = ImageMethod(HEADSET, PERSON, pixels=64, renderer="osmesa")
    first = method.camera(0).render(*STATE)
    drawn = []
    threads = [
        threading.Thread(target=lambda: drawn.append(method.camera(0).render(*STATE))) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(drawn) == 3 and all(np.array_equal(image, first) for image in drawn)


def test_a_missing_libosmesa_is_said_with_its_package(monkeypatch):
    ffi, lib = simulator()

    class WithoutMesa:
        def sim_osmesa_open(self, *args):
            args[-2][0:24] = b"libOSMesa is not there\0\0"
            return ffi.NULL

    method = ImageMethod(HEADSET, PERSON, pixels=16, renderer="osmesa")
    monkeypatch.setattr(osmesa, "simulator", lambda: (ffi, WithoutMesa()))
    with pytest.raises(SceneError) as refused:
        method.response(*STATE)
    assert refused.value.message == "libOSMesa is not there"
    assert "apt-get install libosmesa6" in refused.value.remedy


# Views ----------------------------------------------------------------------------------------------------


def test_a_view_adds_up(led2gaze):
    seen = view(led2gaze, nominal_person(), 3, 5, -5, pixels=64, samples=2)
    assert seen.emitters == (0, 1, 4, 5) and seen.radiance.shape == (4, 64, 64)
    assert np.allclose(seen.radiance, sum(seen.parts.values()), rtol=1e-12)
    assert seen.window.max() <= 1 and seen.solid_angle.sum() == pytest.approx(
        (seen.edges[-1] - seen.edges[0]) ** 2, rel=0.25
    )
    whole = image_response(led2gaze, nominal_person(), 5, -5, pixels=128, half_width_sigmas=3.0)
    assert seen.sums()["total"] == pytest.approx(whole[3, [0, 1, 4, 5]], rel=2e-3)


def test_a_view_has_the_temple_on_the_left_and_the_brow_on_top():
    lamp = port((0.0, -3.0, -35.0), sigma_deg=30.0, lens_radius_mm=0.0)
    camera = port((0.0, 0.0, -40.0), (0.0, 0.0, -11.0), 15.0, 0.0)
    person = replace(nominal_person(), albedo_skin=0.0, albedo_sclera=0.0)
    place = {}
    for gaze in [(15, 0), (-15, 0), (0, 12), (0, -12)]:
        iris = view(pair(camera, lamp), person, 0, *gaze, pixels=96).parts["iris"][0]
        place[gaze] = (np.indices(iris.shape) * iris).sum((1, 2)) / iris.sum()  # row, column
    assert place[15, 0][1] < place[-15, 0][1] - 5
    assert place[0, 12][0] < place[0, -12][0] - 5


def test_glints_are_found_where_they_are_bright(led2gaze):
    seen = view(led2gaze, nominal_person(), 5, 0, 0, pixels=128)
    found = dict(seen.glints())
    assert 2 <= len(found) <= 5
    middle = (seen.edges[1:] + seen.edges[:-1]) / 2
    for number, (x, y) in found.items():
        glint = seen.parts["glint"][seen.emitters.index(number)]
        assert glint[np.argmin(abs(-middle - y)), np.argmin(abs(middle - x))] == glint.max()


@pytest.mark.parametrize(
    "options, words",
    [
        (dict(sensor=6), "no sensor 6"),
        (dict(sensor=-1), "no sensor -1"),
        (dict(emitters=[2, 9]), "no emitter 9"),
        (dict(emitters=[]), "no emitter is lit"),
        (dict(pixels=1), "pixels"),
        (dict(pixels=4097), "4097 pixels"),
        (dict(pixels=3000, samples=2), "3000 pixels"),
        (dict(half_width_sigmas=0.0), "half width"),
        (dict(half_width_sigmas=float("nan")), "half width"),
        (dict(renderer="opengl"), "opengl"),
        (dict(azimuth_deg=61.0), "gaze 61"),
        (dict(elevation_deg=float("nan")), "gaze 0, nan"),
        (dict(pupil_mm=12.0), "pupil 12"),
        (dict(lid_opening=1.1), "lids 1.1"),
        (dict(slip_mm=(0.0, 0.0, 30.0)), "impossible scene"),
    ],
)
def test_impossible_views_are_refused(led2gaze, options, words):
    arguments = dict(sensor=0, azimuth_deg=0.0, elevation_deg=0.0, pixels=16)
    with pytest.raises(SceneError) as refused:
        view(led2gaze, nominal_person(), **{**arguments, **options})
    assert words in refused.value.message and refused.value.remedy


def test_unknown_bits_and_occlusion_are_refused():
    with pytest.raises(SceneError, match="12"):
        expose(np.ones(4), 12)
    with pytest.raises(SceneError, match="rays"):
        ImageMethod(HEADSET, PERSON, renderer="osmesa", occlusion="rays")
