"""Ports and the scanners behind them: bytes on one side, columns on the other."""
