"""The daemon beside the scanner: capture, assemble, keep, plan, serve."""
