"""The parameters of when and how a surface comes to rest: defaults, meanings, units, ranges."""

from __future__ import annotations

from dataclasses import dataclass

from cloth_predict.config.parameter import param


@dataclass(frozen=True)
class RestConfig:
    """The end of the motion of a surface of springs, which the rest node predicts."""

    near: float = param(
        0.005,
        'it rests from when on no marker is farther than this from its place at rest',
        'm',
        above=0,
    )
    longest: float = param(20.0, 'how far ahead the end is looked for', 's', above=0, high=600)
    step: float = param(
        0.04, 'longest step on the way there, of second order', 's', low=1e-4, high=0.2
    )
    period: float = param(0.5, 'time between two such predictions', 's', above=0)
    position: float = param(
        0.003,
        'the rest is told from when sigma of the shape at rest, at the least known marker, is '
        'no more than this',
        'm',
        above=0,
    )
    time: float = param(0.2, 'and sigma of the time of rest no more than this', 's', above=0)
