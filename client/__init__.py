"""The other end of the LAN: find a node, hold a model of its scan, look where detail is wanted."""
