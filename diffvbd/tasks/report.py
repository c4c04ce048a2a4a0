"""What is said at the end of a run: a table of the estimates, and whether the result survives finer settings."""

import torch

import diffvbd as dv
from diffvbd.tasks.problem import Problem, Result, Settings, estimates_of
from diffvbd.tasks.progress import table_of


def survival(problem: Problem, settings: Settings, first: float) -> dv.Refinement | str:
    """Whether the result survives more sweeps and smaller steps, or why that is not known."""
    stage = problem.stages[-1]
    if settings.quick:
        return "not refined: a quick run"
    if not stage.refinable:
        return "not refined: its loss keeps what it finds"
    if stage.before or len(problem.stages) > 1:
        return "not refined: what its loss reads changes during the run"
    state = {name: value.clone() for name, value in problem.state.items()}
    try:
        return dv.refine(stage.loss, before=first)
    except Exception as error:  # more memory or pairs than there is room for: that costs no result
        return f"not refined: {error or type(error).__name__}"
    finally:
        with torch.no_grad():
            for name, value in state.items():
                problem.state[name].copy_(value)


def table(problem: Problem, result: Result) -> str:
    """Start, true and recovered values as aligned text, and how the run ended."""
    seconds, first = result.history[-1]["seconds"], result.history[0]["loss"]
    how = "converged" if result.converged else "stalled" if result.stalled else "stopped"
    start = estimates_of(result.history[0])
    return table_of(start, result.estimates, problem.truth, result.errors, problem.units) + (
        f"\n{how} after {len(result.history)} evaluations in {seconds:.0f} s; "
        f"loss {first:.3g} -> {result.best['loss']:.3g} (lowest at evaluation {result.best['iteration'] + 1:.0f})"
        + (f"\n{result.refined}" if result.refined else "")
    )
