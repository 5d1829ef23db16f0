"""SB3 callbacks: the method's bookkeeping and evaluation."""
