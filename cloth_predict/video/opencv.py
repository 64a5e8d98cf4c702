"""OpenCV, which only videos need: an optional extra of the package."""

from __future__ import annotations

import os

from cloth_predict.errors import ClothPredictError

# read when it is imported: what cannot be decoded is told by this package, in one line
os.environ.setdefault('OPENCV_LOG_LEVEL', 'SILENT')
os.environ.setdefault('OPENCV_FFMPEG_LOGLEVEL', '-8')
try:
    import cv2
except ImportError:
    raise ClothPredictError(
        "videos need OpenCV: install it with pip install 'cloth_predict[video]'"
    ) from None

__all__ = ['cv2']
