"""Claim: `bench kernels` reads ncu's table right: times in any unit, means by time, and what a kernel is bound by."""

import csv
import io
import subprocess
from types import SimpleNamespace

import pytest

from bench import kernels

NAMES = {
    "void unnamed>::scene_kernel<double>(AdvanceInputs<T1>, AdvanceState<T1>)": "scene_kernel, AdvanceInputs",
    "void unnamed>::scene_kernel<double>(diffvbd::contact::RigidInputs<T1>, long)": "scene_kernel, RigidInputs",
    "void diffvbd::cuda::<unnamed>::sweep_reverse<double, (int)13, (int)0>(StepView<T1>, Range)": "sweep_reverse",
}


def table(*launches: dict[str, str]) -> str:
    """ncu's raw page: names, units, and a line for each launch."""
    plain = {kernels.BLOCKS: "4", kernels.REGISTERS: "64", kernels.WARPS: "50", kernels.ISSUES: "10",
             kernels.THREADS: "8"}  # fmt: skip
    plain |= dict.fromkeys(kernels.RATES.values(), "5") | {kernels.STALL.format(s): "0.5" for s in kernels.STALLS}
    keys = ["ID", "Kernel Name", kernels.SECONDS, *plain]
    text = io.StringIO()
    out = csv.writer(text, quoting=csv.QUOTE_ALL)
    out.writerows([keys, ["us" if key == kernels.SECONDS else "" for key in keys]])
    out.writerows([(plain | launch | {"ID": "0"})[key] for key in keys] for launch in launches)
    return "==PROF== Connected to process\n" + text.getvalue()


def test_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep, advance = "sweep_forward<double, 1>(StepView<T1>)", next(iter(NAMES))
    memory, barrier = kernels.RATES["memory"], kernels.STALL.format("barrier")
    text = table(
        {"Kernel Name": sweep, kernels.SECONDS: "1,000", memory: "60", kernels.BLOCKS: "1,024"},
        {"Kernel Name": sweep, kernels.SECONDS: "3,000", memory: "80"},
        {"Kernel Name": advance, kernels.SECONDS: "500", barrier: "7"},
        {"Kernel Name": "fill(int)", kernels.SECONDS: "1"},  # too short for a row
    )
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(stdout=text, stderr="", returncode=0))
    name = next(iter(kernels.SCENES))
    first, second = kernels._rows(name, list(kernels._launches(name, "cuda")))
    assert (first["kernel"], first["launches"], first["blocks"], first["bound"]) == ("sweep_forward", 2, 1024, "memory")
    assert first["seconds"] == pytest.approx(2e-3) and first["rate of memory"] == pytest.approx(0.75)
    assert first["share"] == pytest.approx(4000 / 4501)
    assert (second["kernel"], second["bound"]) == ("scene_kernel, AdvanceInputs", "barriers")
    assert "scene_kernel, AdvanceInputs" in kernels.markdown({"rows": [first, second]})


def test_a_failed_run_says_what_ncu_said(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = SimpleNamespace(stdout="", stderr="==ERROR== no permission", returncode=1)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(RuntimeError, match="no permission"):
        list(kernels._launches(next(iter(kernels.SCENES)), "cuda"))


@pytest.mark.parametrize("text", NAMES)
def test_names(text: str) -> None:
    assert kernels._named(text) == NAMES[text]
