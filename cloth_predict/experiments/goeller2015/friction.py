"""Section 2.1 and 4.5: friction in the step of a bar, three ways, and what the filter costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from cloth_predict.experiments.goeller2015.runs import CONFIG, RATE, Filmed, seeds
from cloth_predict.experiments.rows import Experiment, Row, Scope, short
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import ComplexArray, Ruler
from cloth_predict.simulation.ruler import ANNEX_A, measured, random_shot
from cloth_predict.tracking.ruler import RulerTracker
from cloth_predict.types import FloatArray, Integrator

NO_INPUT = np.zeros(0)
STEP = 0.01
"""Step [s] of all three: that of the filter."""
AFTER = 0.5
"""Time [s] after the bar rests at which what is left of its speed is looked at."""
SHOTS = 20
MODEL = 'the forces as printed, by an explicit method'
COST = '0.9 s for a video of 2 s with 50 frames in a second'


@dataclass(frozen=True)
class Rounded(Ruler):
    """A bar whose friction is mu N v / sqrt(v^2 + eps^2): smooth, and it never quite stops."""

    eps: FloatArray | float = 0.0

    @classmethod
    def like(cls, ruler: Ruler, eps: float) -> Rounded:
        """Round the friction of a bar off below eps [m/s]."""
        return cls(**{f.name: getattr(ruler, f.name) for f in fields(ruler)}, eps=eps)

    @classmethod
    def stable(cls, ruler: Ruler, dt: float) -> Rounded:
        """Round it off as little as RK4 with steps of dt [s] is stable with.

        At rest the fastest motion decays at the rate (1 + s^2 / I) mu g / eps, of which RK4 stands
        2.78 / dt.
        """
        fastest = (ruler.grip * (1.0 + ruler.places**2 / ruler.inertia)).sum()
        return cls.like(ruler, float(fastest) * dt / 2.78)

    def _pulls(self, x: FloatArray, turn: ComplexArray) -> ComplexArray:
        velocity = self._velocities(x, turn)
        return np.asarray(-self.grip * velocity / np.hypot(np.abs(velocity), self.eps))


METHODS: dict[str, tuple[Callable[[Ruler], Ruler], Integrator]] = {
    'as printed': (lambda ruler: ruler, RungeKutta()),
    'rounded off': (lambda ruler: Rounded.stable(ruler, STEP), RungeKutta()),
    'closed form': (lambda ruler: ruler, Sliding(STEP)),
}


def _stops(scope: Scope) -> Row:
    rng = np.random.default_rng(7)
    shots = [*ANNEX_A.values(), *(random_shot(rng) for _ in seeds(scope, SHOTS))]
    off, left = np.zeros((2, len(METHODS), len(shots)))
    for number, shot in enumerate(shots):
        film = Filmed.of(shot)
        for k, (change, method) in enumerate(METHODS.values()):
            ruler, x = change(shot.ruler), shot.start
            for _ in range(round((film.duration + AFTER) / STEP)):
                x = method.step(ruler, x, NO_INPUT, STEP)
            off[k, number] = np.hypot(*(x[:2] - film.rest[:2]))
            left[k, number] = ruler.slip(x).max()
        scope.progress(1.0 / len(shots))
    numbers: dict[str, float] = {}
    for name, error, speed in zip(METHODS, off, left, strict=True):
        numbers[f'{name}: worst place of rest [m]'] = float(error.max())
        numbers[f'{name}: median place of rest [m]'] = float(np.median(error))
        numbers[f'{name}: speed that is left [m/s]'] = float(speed.max())

    def said(name: str) -> str:
        place = 1e3 * numbers[f'{name}: worst place of rest [m]']
        median = 1e3 * numbers[f'{name}: median place of rest [m]']
        speed = 1e3 * numbers[f'{name}: speed that is left [m/s]']
        return (
            f'rests {short(median, "mm")} (median), {short(place, "mm")} (worst) beside the '
            f'truth, still moves at {short(speed, "mm/s")}'
        )

    return Row(
        '2.1',
        MODEL,
        f'RK4 at 10 ms: {said("as printed")}',
        f'closed form where a contact sticks: {said("closed form")}',
        'Friction turns round at each step of a contact that should stand, which is the speed '
        f'that is left. Rounded off as little as RK4 is stable with: {said("rounded off")}.',
        numbers,
    )


def _cost(scope: Scope) -> Row:
    shot = ANNEX_A[3]
    film = Filmed.of(shot, 2.0)
    z = measured(film.states, 1.0, np.random.default_rng(0))
    spent, stop = [], []
    for _ in seeds(scope, 25):
        tracker, start = RulerTracker(CONFIG), time.process_time()
        for frame, seen in enumerate(z):
            tracker.step(round(frame * 1e9 / RATE), seen)
        spent.append(time.process_time() - start)
        start = time.process_time()
        tracker.stop()
        stop.append(time.process_time() - start)
    numbers = {
        'filter over 2 s [s]': float(np.median(spent)),
        'least of all runs [s]': float(min(spent)),
        'a prediction of the stop, 3.2 s ahead [s]': float(np.median(stop)),
    }
    scope.progress(1.0)
    return Row(
        '4.5',
        COST,
        '-',
        f'{short(numbers["filter over 2 s [s]"], "s")} on one core (median; '
        f'{short(numbers["least of all runs [s]"], "s")} at best); a prediction of the stop 3.2 s '
        f'ahead takes {short(1e3 * numbers["a prediction of the stop, 3.2 s ahead [s]"], "ms")}',
        'The 21 sigma points take each step together, as rows of one array.',
        numbers,
    )


EXPERIMENTS = (
    Experiment(('2.1',), MODEL, _stops),
    Experiment(('4.5',), COST, _cost),
)
