"""Claim: the viewer serves a page on this machine alone and to no other site's page, draws in a real browser, plays,
reruns what sliders ask for within their limits, follows an optimisation without changing it, and stops."""

import io
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.browser import page_of

import diffvbd as dv
from diffvbd import results
from diffvbd.viz import live

pytest.importorskip("viser")
MESH = dv.mesh.cube(3, 0.2)
MODEL = dv.Model(MESH, energies=(dv.StableNeoHookean(), dv.FloorBarrier(-0.3)))
STEP = 0.02


def fall(speed: float = 0.0, steps: int = 8) -> results.Trajectory:
    x = MODEL.rest_points
    v = torch.tensor([0.0, speed, 0.0], dtype=x.dtype).expand_as(x)
    return dv.rollout(MODEL, x, v, dv.VBD(STEP, 3), steps=steps, mu=1e4, lam=1e4)


def until(true: Callable[[], Any], seconds: float = 60.0) -> bool:
    """Whether it becomes true, for as long as a busy machine may take."""
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    return bool(true())


def test_it_serves_this_machine_alone_and_stops() -> None:
    before = {thread.name for thread in threading.enumerate()}
    with live(fall(), MODEL, time_step=STEP) as viewer:
        port = int(viewer.url.rpartition(":")[2])
        assert viewer.url.startswith("http://127.0.0.1:") and viewer.clock.playing and not viewer.watched
        with socket.create_connection(("127.0.0.1", port)):
            pass
        with live(MESH, play=False) as other:  # another free port
            assert other.url != viewer.url
        assert viewer.url in viewer._repr_html_()
    viewer.stop()
    with pytest.raises(OSError), socket.create_connection(("127.0.0.1", port)):
        pass
    assert not {n for n in {thread.name for thread in threading.enumerate()} - before if n.startswith("diffvbd")}


@pytest.mark.parametrize(
    ("arguments", "kind", "expected"),
    [
        ({"source": MESH, "color": "heat"}, ValueError, "color: expected one of body, .*, got 'heat'"),
        ({"source": MESH, "color": "stress"}, ValueError, "color: stress needs a dv.Model"),
        ({"source": MESH, "port": 70000}, ValueError, "port: expected an integer <= 65535, got 70000"),
        ({"source": MESH, "host": ""}, TypeError, "host: expected the name"),
        ({"source": MESH, "host": "203.0.113.7"}, ValueError, "host: expected .* of this machine, got '203.0.113.7'"),
        ({"source": "none.pvd"}, FileNotFoundError, "none.pvd does not exist"),
        ({"source": MESH, "sliders": {"mu": (0, 1)}}, TypeError, "source: expected a function of mu for sliders"),
        ({"source": fall, "mesh": MODEL}, ValueError, "sliders: expected ranges of the function's parameters"),
        ({"source": fall, "mesh": MODEL, "sliders": {"speed": (2, 1)}}, ValueError, r"sliders\['speed'\]: expected"),
        ({"source": fall, "mesh": MODEL, "sliders": {"speed": (0, 1, 2)}}, ValueError, "ascending, got"),
        (
            {"source": fall, "mesh": MODEL, "sliders": {"mass": (0, 1)}},
            TypeError,
            "source: expected a function of mass",
        ),
        ({"source": MESH, "colliders": np.zeros((1, 3))}, ValueError, "mesh: expected a dv.Model with colliders"),
    ],
)
def test_what_cannot_be_shown_is_refused(arguments: dict[str, Any], kind: type, expected: str) -> None:
    with pytest.raises(kind, match=expected):
        live(**arguments)


def answer(viewer: dv.viz.Viewer, **headers: str) -> int:
    """Status of a handshake with these headers; 101: a connection is open."""
    _, _, place = viewer.url.rpartition("/")
    host, _, port = place.rpartition(":")
    lines = {"Host": place, "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
             "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="} | headers  # fmt: skip
    text = "".join(f"{name}: {value}\r\n" for name, value in lines.items() if value)
    with socket.create_connection((host, int(port)), timeout=30.0) as connection:
        connection.sendall(f"GET / HTTP/1.1\r\n{text}\r\n".encode())
        return int(connection.recv(100).split()[1])


def test_pages_of_other_sites_are_refused() -> None:
    with live(MESH, play=False) as viewer:
        own = viewer.url.rpartition("/")[2]
        assert answer(viewer, Origin=viewer.url) == answer(viewer) == 101
        assert answer(viewer, Host="localhost:9", Origin="http://localhost:9") == 101  # a port that is forwarded
        for foreign in ("http://site.test", "http://localhost:9", f"http://{own}.site.test", "null"):
            assert answer(viewer, Origin=foreign) == 403
        for host in ("site.test", "site.test:80", "127.0.0.1.site.test", ""):  # as after DNS rebinding
            assert answer(viewer, Host=host, Origin=f"http://{host}") == 403
        assert answer(viewer, Host="site.test", Upgrade="") == 403  # nor does the page itself arrive


def test_values_that_no_slider_has_never_reach_a_function() -> None:
    import msgspec
    import viser
    from websockets.sync.client import connect

    speeds: list[float] = []
    shown = fall().x

    def throw(speed: float) -> torch.Tensor:
        speeds.append(speed)
        return shown

    camera = {"type": "ViewerCameraMessage", "wxyz": (1, 0, 0, 0), "position": (0, 0, 1), "fov": 1, "near": 1, "far": 9,
              "image_height": 9, "image_width": 9, "look_at": (0, 0, 0), "up_direction": (0, 1, 0)}  # fmt: skip
    with live(throw, MODEL, time_step=STEP, sliders={"speed": (0.0, 5.0, 1.0)}, play=False) as viewer:
        viewer._rerun.delay = 0.0  # pyright: ignore[reportOptionalMemberAccess]
        panel, slider = viewer._panel, [*viewer._server.gui._gui_input_handle_from_uuid.values()][-1]
        protocol: Any = [f"viser-v{viser.__version__}"]
        with connect(viewer.url.replace("http", "ws"), subprotocols=protocol, max_size=None) as page:

            def send(handle: Any, value: Any) -> None:
                message = {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}
                page.send(msgspec.msgpack.encode(message))

            page.send(msgspec.msgpack.encode(camera))
            assert until(lambda: viewer.watched)
            for value, kept in ((2.0, 2.0), (1e300, 5.0), (-5.0, 0.0), (3.0, 3.0)):
                send(slider, value)
                assert until(lambda kept=kept: speeds[-1] == slider.value == kept)
            controls = (slider, panel.color, panel.speed, panel.frame)
            for handle, value in zip(controls, (float("nan"), "heat", "nan", 10**9), strict=True):
                send(handle, value)
            assert until(lambda: viewer.frame == 8)  # the last one sent
            assert until(lambda: [handle.value for handle in controls] == [3.0, "body", "1", 8])
    assert all(0.0 <= speed <= 5.0 for speed in speeds)
    assert viewer.color == "body" and viewer.clock.speed == 1.0 and viewer.frame == 8


def test_without_viser_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'diffvbd\[viz\]'"):
        live(MESH)


@pytest.mark.slow
def test_a_browser_draws_plays_and_reruns() -> None:
    images = pytest.importorskip("PIL.Image")
    speeds: list[float] = []

    def throw(speed: float) -> results.Trajectory:
        speeds.append(speed)
        if speed > 4.0:
            raise ValueError("too fast")
        return fall(speed)

    viewer = live(throw, MODEL, time_step=STEP, sliders={"speed": (0.0, 5.0, 1.0)}, play=False, port=8123)
    with viewer, page_of(viewer.url) as (page, asked):

        def shot() -> np.ndarray:
            """The left part of the page, which the controls do not cover."""
            raw = page.screenshot(clip={"x": 20, "y": 160, "width": 620, "height": 480})
            return np.asarray(images.open(io.BytesIO(raw)).convert("RGB"), dtype=int)

        def blue() -> np.ndarray:
            """Where the body is: its color is blue."""
            picture = shot()
            return picture[..., 2] > picture[..., 0] + 40

        page.wait_for_selector("canvas")
        assert until(lambda: viewer.watched)
        assert until(lambda: blue().sum() > 500), "the canvas is blank"
        first = blue()
        viewer.frame = 8
        assert until(lambda: (blue() != first).sum() > 500), "another frame looks the same"

        page.get_by_role("button", name="Play").click()
        assert until(lambda: viewer.clock.playing)
        seen = set()
        assert until(lambda: len(seen.add(viewer.frame) or seen) > 3), "it does not run"
        page.get_by_role("button", name="Pause").click()
        assert until(lambda: not viewer.clock.playing)

        box = page.locator("input[type=text]").last  # the number beside the slider, the last control
        box.fill("3")
        box.press("Enter")
        assert until(lambda: speeds[-1] == 3.0), "the slider reran nothing"
        # the page may still show that it was up to date before
        assert until(lambda: np.array_equal(viewer.motions["motion"].points, fall(3.0).x.numpy()))
        page.get_by_text("up to date").wait_for()
        moved = viewer.motions["motion"].points
        box.fill("4.5")
        box.press("Enter")
        page.get_by_text("too fast").wait_for()
        assert speeds[-1] == 4.5 and np.array_equal(viewer.motions["motion"].points, moved)

        viewer.color = "speed"
        page.get_by_text("speed [m/s]").wait_for()
        viewer.update(loss=2.0, mu=3e4)
        page.get_by_text("30000").wait_for()
        assert all("127.0.0.1" in url for url in asked), asked
