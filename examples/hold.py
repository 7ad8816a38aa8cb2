"""A grip that holds an object with 0.5 N while it is pulled, and grips harder when it starts to slip.

An emulated rig presses on a ball, which recedes and is pulled along the sheet by a growing force, under the
twin's law of friction. Each frame gives the normal force, from its brightness, and the part of the contact
that slips. The controller corrects the travel, and raises the force at each onset of slip. Without it the
force falls, and the ball slides away.
"""

import math
from dataclasses import dataclass, field, replace

import matplotlib.pyplot as plt
import numpy as np

from mirrorskin import engine, hw, io
from mirrorskin.engine.live import Frames, Limit, Stream
from mirrorskin.twin import Body, Camera, SheetTexture, Sphere, Vertical
from mirrorskin.twin.emulator.rig import EmulatedRig
from mirrorskin.twin.emulator.simulated_clock import SimulatedClock

RADIUS, MODULUS, FRICTION = 5.0, 0.2, 0.3  # of the ball, mm; MPa
SIZE, PIXEL, RATE = 48, 0.1, 30.0  # pixels of a side, mm, frames per second
TARGET, MOST = 0.5, 0.65  # N, at first and at most
HARDER, SLIPPING = 1.08, 0.3  # factor of the force at each onset; share of the contact
SECONDS, PULL, RECEDES, VISCOSITY = 3.0, 0.165, 0.1, 0.05  # s, N, mm, N s/mm
LIMITS = 0.0, 1.2  # of the travel, mm; those of the stage are wider
GAIN = 0.5  # share of an error of the force that a frame corrects


class PulledRig(EmulatedRig):
    """A rig whose object recedes, and is pulled to the right by a force that grows, from a time on."""

    start = math.inf
    displacement, last = 0.0, 0.0  # of the object, mm, at a time

    def pull(self, at):
        """Return the force that pulls, N, which grows for three quarters of the time."""
        return PULL * min(max((at - self.start) / (0.75 * SECONDS), 0.0), 1.0)

    def recedes(self, at):
        """Return how far the object has receded, mm."""
        return RECEDES * min(max((at - self.start) / (0.75 * SECONDS), 0.0), 1.0)

    def where(self, at):
        """Return where the body is on the object."""
        if self.start < self.last < at:  # the excess of the pull over the friction moves it
            excess = self.pull(at) - self.grip.force[0]
            self.displacement += excess / VISCOSITY * (at - self.last)
        self.last = max(at, self.last)
        body = super().where(at)
        return replace(body, x=body.x - self.displacement, travel=body.travel - self.recedes(at))


@dataclass
class Record:
    """What happened, one number of each frame; forces in N, lengths in mm."""

    time: list = field(default_factory=list)
    pull: list = field(default_factory=list)
    force: list = field(default_factory=list)  # true
    measured: list = field(default_factory=list)
    target: list = field(default_factory=list)
    slid: list = field(default_factory=list)
    travel: list = field(default_factory=list)
    onsets: list = field(default_factory=list)  # times


def make_rig(clock):
    """Return the emulated rig; on a simulated clock waiting takes no time."""
    return PulledRig(
        Sphere(2 * RADIUS),
        rate=RATE,
        clock=clock,
        shape=(SIZE, SIZE),
        pixel_size=PIXEL,
        contact="elastic",
        pattern="linear",
        body=Body(friction=FRICTION, modulus=MODULUS),
        texture=SheetTexture("flakes", size=0.35, contrast=0.5),
        camera=Camera(noise=1.0, electrons=40.0),
    )


class Gauge:
    """Force and contact of the ball, whose shape is known, from the mean brightness of a frame."""

    def __init__(self, rig):
        """Press step by step, and note the brightness."""
        x, y = io.pixel_axes((SIZE, SIZE), (PIXEL, PIXEL))
        square = x**2 + y[:, np.newaxis] ** 2
        self.ball = np.sqrt(RADIUS**2 - square) - RADIUS
        self.tracker = engine.force.ForceTracker(PIXEL, MODULUS, binning=1)
        self.depths, brightness = np.linspace(0.4, 1.0, 13), []
        for depth in self.depths:
            rest = rig.go(hw.Position(travel=depth))
            frames = rig.take(64)
            while frames.time[-1] < rest.time + 2 / RATE:
                frames = rig.take(64)
            brightness.append(frames.pixels[-1].mean())
        self.brightness = np.polynomial.Polynomial.fit(self.depths, brightness, 3)(self.depths)
        self.forces = [self.at(depth).force for depth in self.depths]

    def at(self, depth):
        """Return the forces of a depth, mm."""
        return self.tracker.push(self.ball, travel=depth)

    def depth_of(self, force):
        """Return the depth of a force, mm."""
        return float(np.interp(force, self.forces, self.depths))

    def push(self, update):
        """Return the forces of a frame."""
        return self.at(float(np.interp(update.picture.mean(), self.brightness, self.depths)))


def hold(controlled=True, clock=None):
    """Hold the object; return what happened. An error on the way stops the stage, as leaving the rig does."""
    clock, record, updates = clock or SimulatedClock(), Record(), []
    with (
        make_rig(clock) as emulated,
        hw.open_rig(
            emulated.settings,
            clock=clock,
            open_stage=emulated.open_stage,
            open_camera=emulated.open_camera,
        ) as rig,
    ):
        gauge, target = Gauge(rig), TARGET
        travel = gauge.depth_of(target)
        rig.go(hw.Position(travel=0.0))  # the speckles that are followed are those of a new contact
        rig.go(hw.Position(travel=travel))
        trackers = {"force": gauge.push, "slip": new_grip(gauge, target)}
        events = {"slip": Limit.slip(SLIPPING)}
        with Stream(
            Frames(),
            (SIZE, SIZE),
            latency=math.inf,
            trackers=trackers,
            events=events,
            on_update=lambda update, status: updates.append(update),
        ) as stream:
            rig.camera.flush()
            emulated.start = start = clock.now()
            while clock.now() < start + SECONDS:
                frames = rig.take(64)
                for pixels, time in zip(frames.pixels, frames.time, strict=True):
                    stream.push(pixels, travel=travel, time=time - start + 1)
                stream.result()  # all of them are processed
                update = updates[-1]
                force = update.tracked["force"].force
                note(record, emulated, clock.now() - start, force, target, travel)
                starts = any(event.started for update in updates for event in update.events)
                updates.clear()
                if starts:
                    record.onsets.append(record.time[-1])
                if not controlled:
                    continue
                if starts:
                    target = min(HARDER * target, MOST)
                    trackers["slip"] = new_grip(gauge, target)
                step = GAIN * (gauge.depth_of(target) - gauge.depth_of(force))
                travel = min(max(travel + step, LIMITS[0]), LIMITS[1])
                rig.go(hw.Position(travel=travel))
        rig.go(hw.Position(travel=LIMITS[0]))
    return record


def new_grip(gauge, force):
    """Return a tracker of the slip from now on."""
    contact = gauge.at(gauge.depth_of(force)).contact
    return engine.slip.SlipTracker(contact, PIXEL)


def note(record, emulated, time, force, target, travel):
    """Write down what is measured, and what is true."""
    at = emulated.clock.now()
    true = emulated.twin(Vertical([emulated.where(at).travel])).sheet(0).force
    grip = emulated.grip
    values = time, emulated.pull(at), true, force, target, math.hypot(*grip.slid), travel
    for name, value in zip(
        ("time", "pull", "force", "measured", "target", "slid", "travel"), values, strict=True
    ):
        getattr(record, name).append(value)


def main():
    """Hold with the controller and without; print and draw what happened."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained", sharex=True)
    for (above, below), controlled in zip(axes.T, (True, False), strict=True):
        record = hold(controlled)
        name, onsets = "with" if controlled else "without", len(record.onsets)
        print(
            f"{name} the controller: force {min(record.force):.3f} to {max(record.force):.3f} N,"
            f" {onsets} onset{'s' * (onsets != 1)} of slip, slid by {1e3 * max(record.slid):.1f} µm"
        )
        above.plot(record.time, record.target, color="0.6", linewidth=3, label="target")
        above.plot(record.time, record.force, color="tab:red", label="true")
        above.plot(record.time, record.measured, ".", markersize=4, label="measured")
        above.plot(record.time, record.pull, color="k", linewidth=1, label="pull along the sheet")
        above.set(title=f"{name} the controller", ylabel="force (N)", ylim=(0, 0.75))
        above.legend(loc=(0.02, 0.22))
        below.plot(record.time, 1e3 * np.array(record.slid))
        for onset in record.onsets:
            below.axvline(onset, color="tab:orange", linewidth=1)
        below.set(xlabel="time (s)", ylabel="slide (µm), and onsets of slip", ylim=(-50, 1000))
    figure.savefig("hold.png", dpi=80)


if __name__ == "__main__":
    main()
