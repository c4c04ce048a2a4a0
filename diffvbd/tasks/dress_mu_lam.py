"""Identify both Lame parameters of a dress that drapes over a mannequin, from vertex positions (paper, section 6.5).

The scene, the two stages and the choices are those of `dress`; everything is observed.
"""

from diffvbd.tasks import dress
from diffvbd.tasks.problem import Problem, Settings


def problem(settings: Settings) -> Problem:
    return dress.problem("dress-mu-lam", settings, observe=lambda frames: frames)
