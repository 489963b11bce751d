"""What the study's tables call the strategies."""

from __future__ import annotations

OURS, ED, GRDP, INSTANTANEOUS, BOUND = "ours", "ED", "GRDP", "instantaneous", "preview"
#: Rows of the strongest rival start with this; behind it stands the power a change of the share has to save.
INSTANTANEOUS_SLIP = "instantaneous_slip"
PAPER_SDP = "SDP, paper's problem"
FREE_BOUND = "preview, changes free"
GATE_OFF = "SDP without skid avoidance"
GATE_TABLE_2 = "SDP with Table 2"
