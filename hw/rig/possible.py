"""Whether a stage can do what a plan asks of it; told before anything moves."""

from __future__ import annotations

from mirrorskin.hw.rig.plans import AxialPlan, Plan
from mirrorskin.hw.settings import StageSettings
from mirrorskin.hw.stage import Position


def check_plan(plan: Plan, stage: StageSettings, name: str) -> None:
    """Refuse a plan that a stage cannot do: places beyond its limits, too fast, too slow, no axes for arcs.

    Parameters
    ----------
    plan : VerticalPlan or AxialPlan
    stage : StageSettings
        As the rig file says.
    name : str
        What to call the stage in messages.

    Raises
    ------
    InputError
        Naming what cannot be done, and the remedy.
    """
    from mirrorskin.hw.grbl.moves import Axes

    plan.check(stage.limits, name)
    if plan.in_steps:  # moves between steps go as fast as the axes do
        return
    axes = Axes(stage, name)
    if isinstance(plan, AxialPlan):
        # One turn is as possible as many, wherever the work coordinates begin.
        axes.arcs(plan.tilt, min(plan.turns, 1.0), plan.rate or 0.0, 0.0, axes.machine(Position()))
    else:
        axes.straight(plan.first, Position(plan.stop), plan.speed)
