import cases_web
import numpy as np
import pytest
from cases_web import needs_chromium

from kfgs.cameras import Camera
from kfgs.viewer.page import inline_script
from kfgs.viewer.window import letterboxed

pytestmark = needs_chromium
UP = [0.0, -0.6, 0.8]


@pytest.fixture(scope="module")
def page():
    with cases_web.software_chromium() as browser:
        page = browser.new_page()
        page.set_content(f"<script>{inline_script(('camera.js',))}</script>")
        yield page


@pytest.fixture
def call(page):
    """Call a function of camera.js; the view comes first."""
    return lambda name, *arguments: page.evaluate("([name, given]) => kfgs[name](...given)", [name, list(arguments)])


def a_view(call):
    return call("lookAt", [1.0, 2.0, 3.0], [4.0, -1.0, 5.0], UP)


def check_rotation(view):
    R = np.array(view["R"]).reshape(3, 3)
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-9
    assert np.linalg.det(R) == pytest.approx(1)
    return R


def pivot(view):
    return np.array(view["position"]) + view["distance"] * np.array(view["R"][6:])


def test_look_at_sees_the_point_in_the_middle_with_a_level_horizon(call):
    view = a_view(call)
    R = check_rotation(view)
    assert R[2] == pytest.approx(np.array([3, -3, 2]) / 22**0.5)
    assert R[0] @ UP == pytest.approx(0, abs=1e-12)
    assert R[1] @ UP < 0  # y points down
    assert pivot(view) == pytest.approx([4, -1, 5])


def test_a_camera_of_the_pack_comes_back(call):
    view = a_view(call)
    viewmat = call("viewmatOf", view)
    point = np.array(viewmat).reshape(4, 4) @ [4, -1, 5, 1]
    assert point[:3] == pytest.approx([0, 0, view["distance"]], abs=1e-5)
    again = call("viewOf", viewmat, view["distance"])
    assert again["position"] == pytest.approx(view["position"], abs=1e-5)
    assert again["R"] == pytest.approx(view["R"], abs=1e-6)


@pytest.mark.parametrize(("yaw", "pitch"), [(0.3, 0), (0, 0.2), (-2, -0.4)])
def test_orbit_keeps_the_pivot_and_the_horizon(call, yaw, pitch):
    view = a_view(call)
    turned = call("orbit", view, yaw, pitch, UP)
    R = check_rotation(turned)
    assert pivot(turned) == pytest.approx(pivot(view))
    assert turned["distance"] == view["distance"]
    assert R[0] @ UP == pytest.approx(0, abs=1e-9)
    angle = np.arcsin(R[2] @ UP) - np.arcsin(np.array(view["R"][6:]) @ UP)
    assert angle == pytest.approx(pitch)


def test_orbit_does_not_tip_over(call):
    for pitch in (10, -10):
        turned = call("orbit", a_view(call), 0, pitch, UP)
        assert abs(np.array(turned["R"][6:]) @ UP) == pytest.approx(np.cos(0.02))
        assert np.array(turned["R"][3:6]) @ UP < 0


def test_looking_around_stays_in_place(call):
    view = a_view(call)
    turned = call("lookAround", view, 0.5, -0.1, UP)
    assert turned["position"] == view["position"]
    check_rotation(turned)


def test_pan_moves_the_pivot_with_the_pointer(call):
    view = a_view(call)
    moved = call("pan", view, 30, -12, 500)
    R = np.array(view["R"]).reshape(3, 3)
    seen = R @ (pivot(view) - moved["position"])  # where the old pivot is seen now
    assert 500 * seen[:2] / seen[2] == pytest.approx([30, -12])


def test_zoom_keeps_the_pivot(call):
    view = a_view(call)
    closer = call("zoom", view, 0.5)
    assert closer["distance"] == pytest.approx(view["distance"] / 2)
    assert pivot(closer) == pytest.approx(pivot(view))


def test_fly_moves_along_the_axes(call):
    view = a_view(call)
    flown = call("fly", view, [1, 2, 3])
    R = np.array(view["R"]).reshape(3, 3)
    assert R @ (np.array(flown["position"]) - view["position"]) == pytest.approx([1, -2, 3])


def test_fit_makes_a_ball_touch_the_border(call):
    view = call("fit", a_view(call), [5.0, 5, 5], 0.5, 0.8)
    assert pivot(view) == pytest.approx([5, 5, 5])
    assert np.sin(0.4) * view["distance"] == pytest.approx(0.5)


def test_between_starts_and_ends_where_it_should(call):
    one, two = a_view(call), call("orbit", a_view(call), 1, 0.1, UP)
    for t, end in ((0, one), (1, two)):
        assert call("between", one, two, t)["R"] == pytest.approx(end["R"])
    check_rotation(call("between", one, two, 0.5))


def test_letterboxed_is_that_of_python(call):
    camera = Camera(np.eye(4), [[70.0, 0, 30], [0, 90, 45], [0, 0, 1]], 90, 66)
    K = camera.K
    given = {"viewmat": [], "K": [70, 90, 30, 45], "width": 90, "height": 66, "near": 0.1}
    for width, height in ((200, 100), (50, 400)):
        K = letterboxed(camera, height, width).K
        made = call("letterboxed", given, width, height)
        assert [made[name] for name in ("fx", "fy", "cx", "cy")] == pytest.approx(
            K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        )
