"""The command `ruler`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cloth_predict.command_line.options import Add, progress_bar
from cloth_predict.config.ruler_video import load_ruler_video
from cloth_predict.formats.files import make_folder, writing


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'ruler', _ruler, 'follow a sliding bar in a video: its friction, and where it will rest'
    )
    parser.add('video', type=Path, help='MP4 file, or folder of numbered PNG files')
    parser.config().json()
    parser.add('-o', '--output', type=Path, required=True, help='folder for the results')


def _ruler(options: argparse.Namespace) -> None:
    from cloth_predict.video.commands import follow  # OpenCV, an optional extra

    config = load_ruler_video(options.config)
    make_folder(options.output)
    with progress_bar('ruler', 'frame')(0) as bar:
        report = follow(options.video, config, options.output / 'overlay.mp4', bar.update)
    summary = json.dumps(report.summary(), indent=2)
    with writing(options.output):
        (options.output / 'ruler.json').write_text(summary + '\n', encoding='utf-8')
        (options.output / 'ruler.md').write_text(report.text() + '\n', encoding='utf-8')
    print(json.dumps(report.summary()) if options.json else report.text())
