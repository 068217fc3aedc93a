"""What both ends of a wire must agree on: grids, lattices, holdings, reconstruction, codecs, framing, messages.

Everything here is pure: no sockets, no threads, no clocks. Time, where it matters, is an argument.
"""
