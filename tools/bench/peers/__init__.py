# SPDX-License-Identifier: Apache-2.0
"""What others would put on the Nano: models trained, written out as C, run on a simulated chip."""
