"""The method in plain torch: reads like the paper, knows no SB3, no environments, files or logging."""
