# SPDX-License-Identifier: Apache-2.0
"""Colours of every picture of the project: the Okabe-Ito set, told apart with any kind of colour vision.

The page (`assets/report.css`) knows the same colours as --c0 .. --c7, with lighter ones for a dark background; SVG
figures are re-coloured to them by these exact values.
"""

from __future__ import annotations

#: Blue, vermilion, green, purple, ochre, sky blue, grey, black.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b8609a", "#c98700", "#3a9bd4", "#7a828c", "#1b1f23")
#: Axes and text.
INK = "#1b1f24"
