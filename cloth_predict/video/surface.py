"""The augmented view of a surface, seen by a camera that stands still."""

from __future__ import annotations

import numpy as np

from cloth_predict.overlay import (
    ESTIMATE,
    FORCE,
    PREDICTION,
    Shown,
    dashes,
    dashes_of_net,
)
from cloth_predict.types import BoolArray, FloatArray, Surface
from cloth_predict.video.drawing import INK, Colour, arrows, dots, lines, words
from cloth_predict.video.files import Picture
from cloth_predict.video.view import BAND, SIZE, Camera

PAPER = 255
WIDE, THIN, DENSE = 2, 1, 40.0
"""Widths of lines: of edges that face the camera, and of those that do not or are close together,
most of them no longer than this [px]."""
FAINT = 0.35
"""How much of the colour an edge has that does not face the camera."""
DOT = 3.5
"""Radius of a marker [px]."""
SAMPLE, ROW, COLUMN = 44.0, 24.0, 360.0
"""Length of a line, height of a row and width of a column of the legend [px]."""


def augmented(shown: Shown | None, markers: FloatArray, time: float, camera: Camera) -> Picture:
    """Picture of what is known after a frame, at a time [s] of the recording.

    shown: None where there is no surface yet; markers [m], shape (m, 3): of the frame.
    """
    picture: Picture = np.full((SIZE[1], SIZE[0], 3), PAPER, np.uint8)
    project = camera.pinhole.project
    if shown is not None:
        _nets(picture, shown, camera)
    dots(picture, project(markers), INK, DOT)
    if shown is not None:
        faces = _facing(shown.estimate, camera)
        arrows(picture, project(shown.arrows[faces[shown.pushed]]), FORCE, WIDE)
    _legend(picture, shown, time, camera)
    return picture


def _nets(picture: Picture, shown: Shown, camera: Camera) -> None:
    """Draw the prediction and over it the estimate, of both what is behind first."""
    for near in (False, True):
        for surface, colour in ((shown.prediction, PREDICTION), (shown.estimate, ESTIMATE)):
            if surface is None:
                continue
            faces = _facing(surface, camera)[shown.edges].any(axis=1)
            edges = surface.position[shown.edges[faces == near]]
            segments = dashes_of_net(edges) if colour is PREDICTION else edges
            pixels = camera.pinhole.project(segments)
            width = WIDE if near and _apart(edges, camera) else THIN
            lines(picture, pixels, colour if near else _faint(colour), width)


def _facing(surface: Surface, camera: Camera) -> BoolArray:
    """Which nodes face the camera, shape (nodes,): of a sheet all."""
    if surface.normal is None:
        return np.ones(len(surface.position), bool)
    ray = camera.pinhole.origin - surface.position
    return np.asarray(np.einsum('ni,ni->n', ray, surface.normal) > 0.0)


def _apart(edges: FloatArray, camera: Camera) -> bool:
    """Whether edges [m], shape (e, 2, 3), are longer than `DENSE`, most of them."""
    lengths = camera.scale * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    return 2 * int((lengths > DENSE).sum()) > len(edges)


def _faint(colour: Colour) -> Colour:
    red, green, blue = (1.0 - FAINT * (1.0 - part) for part in colour)
    return red, green, blue


def _legend(picture: Picture, shown: Shown | None, time: float, camera: Camera) -> None:
    """Say what is what; forces are as they are shown in the middle of the view."""
    left, top = 30.0, SIZE[1] - BAND + ROW
    at = np.array([[left, top], [left + SAMPLE, top]])
    down, across = np.array([0.0, ROW]), np.array([COLUMN, 0.0])
    dots(picture, at.mean(axis=0)[None], INK, DOT)
    _name(picture, at, 'markers')
    state = f'{time:.2f} s'
    if shown is not None:
        state = f'{state}: {shown.health}'
        lines(picture, (at + down)[None], ESTIMATE, WIDE)
        _name(picture, at + down, 'estimate')
        if shown.prediction is not None:
            lines(picture, dashes((at + across)[None], SAMPLE / 6), PREDICTION, WIDE)
        _name(picture, at + across, shown.ahead)
    if shown is not None and len(shown.pushed):
        arrows(picture, (at + across + down)[None], FORCE, WIDE)
        force = SAMPLE / (camera.scale * shown.scale)
        _name(picture, at + across + down, f'unknown force of {force:.2g} N')
    words(picture, state, (round(left), round(top + 2.6 * ROW)))


def _name(picture: Picture, sample: FloatArray, text: str) -> None:
    right, height = sample[1]
    words(picture, text, (round(right + 12.0), round(height + 5.0)))
