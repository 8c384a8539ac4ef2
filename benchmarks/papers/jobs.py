"""Every table and figure that is made of driven episodes, in the order in which they are made."""

from __future__ import annotations

from benchmarks import altruism
from benchmarks.papers import conditions, decisions, figure9, phi, t_figure8, t_figures, table3

JOBS = (
    table3.JOB,
    figure9.JOB,
    t_figures.JOB,
    t_figure8.JOB,
    phi.JOB,
    conditions.JOB,
    decisions.JOB,
    altruism.JOB,
)
