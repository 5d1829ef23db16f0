"""Network bodies in plain torch; knows no SB3, no buffers, no reward scales."""
