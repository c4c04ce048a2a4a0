"""Claim: `bench kernels` reads ncu's table right: means by time, what a kernel is bound by, none that is left out."""

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench import common, kernels

NAME = "scene_kernel, AdvanceInputs"
NAMES = {
    "void unnamed>::scene_kernel<double>(AdvanceInputs<T1>, AdvanceState<T1>)": NAME,
    "void unnamed>::scene_kernel<double>(diffvbd::contact::RigidInputs<T1>, long)": "scene_kernel, RigidInputs",
    "void diffvbd::cuda::<unnamed>::sweep_reverse<double, (int)13, (int)0>(StepView<T1>, Range)": "sweep_reverse",
    "void diffvbd::(anonymous namespace)::scene_kernel<double>(diffvbd::AdvanceInputs<double>)": NAME,
    "void diffvbd::cuda::<unnamed>::small_bodies<(int)8, double, diffvbd::cuda::<unnamed>::Begin<double, (bool)0>>"
    "(diffvbd::rigid::Inputs<T2>, T3, int, int)": "small_bodies, Begin",
    "void diffvbd::cuda::(anonymous namespace)::small_bodies<8, double, diffvbd::cuda::(anonymous namespace)::"
    "ReverseBegin<double, false> >(diffvbd::rigid::Inputs<double>, int, int)": "small_bodies, ReverseBegin",
    "void at::native::vectorized_elementwise_kernel<2, at::native::CUDAFunctor_add<double>, std::array<char*, 3ul> >"
    "(int, at::native::CUDAFunctor_add<double>, std::array<char*, 3ul>)": "vectorized_elementwise_kernel",
}


def table(*launches: dict[str, str]) -> str:
    """ncu's raw page: names, units, and a line for each launch."""
    plain = {kernels.BLOCKS: "4", kernels.REGISTERS: "64", kernels.WARPS: "50", kernels.ISSUES: "10",
             kernels.THREADS: "8"}  # fmt: skip
    plain |= dict.fromkeys(kernels.RATES.values(), "5") | {kernels.STALL.format(s): "0.5" for s in kernels.STALLS}
    keys = ["Kernel Name", kernels.CYCLES, *plain]
    text = io.StringIO()
    out = csv.writer(text, quoting=csv.QUOTE_ALL)
    out.writerows([keys, ["cycle" if key == kernels.CYCLES else "" for key in keys]])
    out.writerows([(plain | launch)[key] for key in keys] for launch in launches)
    return "==PROF== Connected to process\n" + text.getvalue()


def test_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep, advance = "sweep_forward<double, 1>(StepView<T1>)", next(iter(NAMES))
    memory, barrier = kernels.RATES["memory"], kernels.STALL.format("barrier")
    text = table(
        {"Kernel Name": sweep, kernels.CYCLES: "1,000", memory: "60", kernels.BLOCKS: "1,024"},
        {"Kernel Name": sweep, kernels.CYCLES: "3,000", memory: "80"},
        {"Kernel Name": advance, kernels.CYCLES: "500", barrier: "7"},
        {"Kernel Name": "fill(int)", kernels.CYCLES: "1"},  # too short for a row
    )
    times = {"sweep_forward": (20, 0.08), NAME: (1, 0.019), "fill": (1, 0.001), "missed": (1, 0.01)}
    monkeypatch.setattr(kernels, "_process", lambda *_: text)
    name = next(iter(kernels.SCENES))
    first, second, third = kernels._rows(name, times, list(kernels._launches(name, "cuda")))
    assert (first["kernel"], first["launches"], first["looked at"]) == ("sweep_forward", 20, 2)
    assert (first["blocks"], first["bound"]) == (1024, "memory")
    assert first["seconds"] == pytest.approx(4e-3) and first["rate of memory"] == pytest.approx(0.75)
    assert first["share"] == pytest.approx(0.08 / 0.11)
    assert (second["kernel"], second["bound"]) == (NAME, "barriers")
    assert (third["kernel"], third["looked at"], third["bound"]) == ("missed", 0, None)
    text = kernels.markdown({name: {"rows": [first, second, third], "failed": "", **common.stamp({})}})
    assert NAME in text and "missed" in text


def test_a_failed_process_says_what_it_said() -> None:
    with pytest.raises(RuntimeError, match="no permission"):
        kernels._process([sys.executable, "-c", "raise SystemExit('no permission')"], "a scene")


def test_processes_end_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "LONGEST", 0.5)
    with pytest.raises(subprocess.TimeoutExpired):
        kernels._process([sys.executable, "-c", "import time; time.sleep(600)"], "a scene")


@pytest.mark.parametrize("text", NAMES)
def test_names(text: str) -> None:
    assert kernels._named(text) == NAMES[text]


def test_each_scene_is_written_as_it_ends(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first, second = list(kernels.SCENES)[:2]

    def times(name: str, device: str) -> dict[str, tuple[int, float]]:
        if name == second:
            raise KeyboardInterrupt
        return {"fill": (2, 0.5)}

    monkeypatch.setattr(kernels.shutil, "which", lambda name: name)
    monkeypatch.setattr(kernels, "_times", times)
    monkeypatch.setattr(kernels, "_launches", lambda name, device: iter(()))
    with pytest.raises(KeyboardInterrupt):
        kernels.run(False, "cpu", f"{first};{second}", tmp_path)
    written = json.loads((tmp_path / "kernels.json").read_text(encoding="utf-8"))["results"]
    assert list(written) == [first] and written[first]["rows"][0]["seconds"] == 0.25
