"""Takes the pictures of docs/viewer.md: `python docs/images/screenshots.py`. Needs playwright and Chromium."""

from __future__ import annotations

import io
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import diffvbd as dv
from diffvbd import results

FOLDER = Path(__file__).parent
ARGUMENTS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SETTLED = 4.0  # [s] until a browser that draws in software has drawn


def main() -> None:
    """Take all pictures."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("screenshots: expected chromium or google-chrome in PATH, got neither")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tools:
        chromium = tools.chromium.launch(executable_path=browser, args=[*ARGUMENTS])
        for name, show in PICTURES.items():
            page = chromium.new_page(viewport={"width": 900, "height": 620}, device_scale_factor=1)
            path = FOLDER / f"viewer_{name}.webp"
            show(lambda viewer, page=page, path=path: take(viewer, page, path))
            page.close()
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")
        chromium.close()


def take(viewer: dv.viz.Viewer, page: Any, path: Path) -> None:
    """A picture of the page."""
    from PIL import Image

    page.goto(viewer.url)
    page.wait_for_selector("canvas")
    time.sleep(SETTLED)
    notice = page.locator(".mantine-Notification-closeButton")  # of software that draws
    if notice.count():
        notice.first.click()
        time.sleep(1.0)
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(path, quality=80, method=6)


def scene() -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    """Three bodies that fall on a floor and a ball, their positions and velocities."""
    bodies = [dv.mesh.cube(5, 0.2, split="kuhn"), dv.mesh.capsule(0.09, 0.15, 5), dv.mesh.cube(5, 0.16, split="kuhn")]
    places = [(-0.2, 0.35, -0.1), (0.1, 0.45, 0.0), (0.05, 0.75, 0.02)]
    mesh = dv.mesh.join([body.translate(place) for body, place in zip(bodies, places, strict=True)])
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(0.0, damping=2.0), dv.PairBarrier(damping=2.0))
    model = dv.Model(mesh, energies=energies, colliders=[dv.colliders.Sphere((0.25, 0.12, 0.05), 0.12)])
    return model, model.rest_points, torch.zeros_like(model.rest_points)


def motion(picture: Callable[[dv.viz.Viewer], None]) -> None:
    """Bodies that land, colored by speed."""
    model, x, v = scene()
    material = {"mu": 4e4, "lam": 4e4}
    run = dv.rollout(model, x, v, dv.VBD(0.01, 12), steps=60, **material)
    with dv.viz.live(run, model, time_step=0.01, color="speed", play=False, **material) as viewer:
        viewer.frame = 32
        picture(viewer)


def optimisation(picture: Callable[[dv.viz.Viewer], None]) -> None:
    """A beam's shear modulus while it is looked for."""
    mesh = dv.mesh.beam(11, 5, 5, size=(0.5, 0.2, 0.2), split="kuhn")
    model = dv.Model(mesh, pinned=mesh.points[:, 0] == 0.0)
    x0 = model.rest_points

    def simulate(mu: Any) -> torch.Tensor:
        return dv.rollout(model, x0, torch.zeros_like(x0), dv.VBD(0.01, 12), steps=30, mu=mu, lam=5e4).x

    with torch.no_grad():
        observed = simulate(6e4)
    log_mu = torch.tensor(1.5e4, dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.Adam([log_mu], 0.2, betas=(0.5, 0.9))
    with dv.viz.live(model, time_step=0.01, play=False) as viewer:
        for _ in range(15):
            optimizer.zero_grad()
            x = simulate(log_mu.exp())
            loss = (x - observed).square().mean()
            loss.backward()
            viewer.update(x, loss=loss, mu=log_mu.exp(), gradient=log_mu.grad)
            optimizer.step()
        viewer.play()
        picture(viewer)


def sliders(picture: Callable[[dv.viz.Viewer], None]) -> None:
    """A motion behind two sliders."""
    model, x, _ = scene()

    def simulate(mu: float, speed: float) -> results.Trajectory:
        v = torch.tensor([speed, 0.0, 0.0], dtype=x.dtype).expand_as(x)
        return dv.rollout(model, x, v, dv.VBD(0.01, 10), steps=40, mu=mu, lam=4e4)

    ranges = {"mu": (1e4, 1e5, 2e4), "speed": (-1.0, 1.0, 0.5)}
    with dv.viz.live(simulate, model, time_step=0.01, sliders=ranges, play=False) as viewer:
        viewer.frame = 30
        picture(viewer)


PICTURES: dict[str, Callable[[Callable[[dv.viz.Viewer], None]], None]] = {
    "motion": motion,
    "optimisation": optimisation,
    "sliders": sliders,
}


if __name__ == "__main__":
    main()
