# SPDX-License-Identifier: Apache-2.0
"""What the study's tables call the strategies."""

from __future__ import annotations

OURS, ED, GRDP, INSTANTANEOUS, BOUND = "ours", "ED", "GRDP", "instantaneous", "preview"
#: Rows of the strongest rival start with this; behind it stands the power a change of the share has to save.
INSTANTANEOUS_SLIP = "instantaneous_slip"
#: Names in `variants.VARIANTS`.
PAPER_SDP, GATE_OFF, GATE_TABLE_2 = "paper_sdp", "paper_sdp_ungated", "paper_sdp_table2"
FREE_BOUND = "preview, changes free"
#: What these pages call possible.
POSSIBLE = (
    "the most that any strategy saved with no more changes of the split than our budget, preview, which knows the "
    "whole cycle in advance, among them; with more changes, more can be saved"
)
