"""Software scanners with known truth. Nobody imports this package: it is started as a process."""
