# SPDX-License-Identifier: Apache-2.0
"""The control-oriented model: one equation group a file."""
