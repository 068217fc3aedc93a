"""Every error this project raises on purpose, as one tree.

FoveascanError
├── WireError            a rule of a wire was broken
│   ├── LocalWireError   by us: the caller asked for something the protocol forbids
│   └── RemoteWireError  by the other end: malformed, oversized or out of order
├── LatticeError         parameters that describe no lattice (also a ValueError)
├── CodecError           a payload that does not decode to what was announced
├── DriverError
│   ├── PortLost         the port or the device behind it is gone
│   └── ScannerFault     the scanner answered, and said no
│       └── Unsupported  since it cannot do such a thing
├── LibraryError         a scan on disk that cannot be read, written or found
├── AccessError          who may come in: a certificate, token or code that cannot be read, written or found
├── InstallError         the service cannot be installed, updated or removed
└── ConfigError          a setting with a wrong type, an unknown key or a value out of bounds (also a ValueError)
    └── UsageError       one that the command line gave
"""


class FoveascanError(Exception):
    """Base of every error raised on purpose."""


class WireError(FoveascanError):
    """A rule of a wire was broken."""


class LocalWireError(WireError):
    """We broke it: the caller asked for something the protocol forbids."""


class RemoteWireError(WireError):
    """The other end broke it: malformed, oversized or out of order."""


class LatticeError(FoveascanError, ValueError):
    """Parameters that describe no lattice."""


class CodecError(FoveascanError):
    """A payload that does not decode to what was announced."""


class DriverError(FoveascanError):
    """Something between us and the scanner failed."""


class PortLost(DriverError):
    """The port, or the device behind it, is gone."""


class ScannerFault(DriverError):
    """The scanner answered, and said no."""


class Unsupported(ScannerFault):
    """The scanner cannot do what was asked."""


class LibraryError(FoveascanError):
    """A scan on disk that cannot be read, written or found."""


class AccessError(FoveascanError):
    """A certificate, a token or a pairing code that cannot be read, written or found."""


class InstallError(FoveascanError):
    """The service cannot be installed, updated or removed."""


class ConfigError(FoveascanError, ValueError):
    """A setting with a wrong type, an unknown key or a value out of bounds."""


class UsageError(ConfigError):
    """A value on the command line that makes no sense."""
