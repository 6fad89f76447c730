"""The error tree. Each error names the device or file, what was expected and seen, and what to do.

EcholumeError                     exit code 1
├── ConfigError                   the rig file, plan or command line is wrong (carries the path, ``$.guide.port``)   2
├── BusError
│   ├── PayloadError              a payload that lies about its shape, or a header that cannot be read
│   ├── NoReplyError              nobody answered a command: service down, wrong rig name, or access denied          3
│   ├── CommandRefusedError       the service answered, and said no (reason inside)                                  4
│   └── RouterUnreachableError    no router at the configured endpoint                                               3
├── DeviceError
│   ├── DeviceAbsentError         the port does not exist or somebody else holds it                                  5
│   ├── DeviceSilentError         the device did not answer within its deadline                                      5
│   ├── DeviceFaultError          the device answered with an alarm or error code                                    5
│   └── ProtocolError             the device answered something its protocol does not allow                          5
├── CalibrationError
│   ├── CalibrationMissingError   no calibration, or one of another rig                                              6
│   └── CalibrationRejectedError  the data do not support a calibration (reason inside)                              6
├── ArchiveError                  the archive cannot be written or read (disk full, cut, not an archive)             7
└── ScanError
    ├── WrongStateError           the command does not fit the run state (states inside)                             4
    ├── LeaseHeldError            somebody else commands the rig                                                     4
    └── IncompleteScanError       the ledger did not close; the missing triggers are named                           8
"""


class EcholumeError(Exception):
    """Root of every error that echolume raises on purpose."""

    exit_code = 1


class ConfigError(EcholumeError):
    """A file or an argument is wrong, e.g. ``rig.toml: $.guide.prot: unknown key``."""

    exit_code = 2


class BusError(EcholumeError):
    """Something went wrong between two services."""


class PayloadError(BusError):
    """A payload or header does not follow the format, e.g. an NPY header that promises more than there is."""


class NoReplyError(BusError):
    """Nobody answered a command."""

    exit_code = 3


class RouterUnreachableError(BusError):
    """No router answers at the configured endpoint."""

    exit_code = 3


class CommandRefusedError(BusError):
    """A service answered a command with a refusal."""

    exit_code = 4
    error_name: str = ""
    """The service's own name of the error, where it has no class here."""


class DeviceError(EcholumeError):
    """A device failed; the message names it."""

    exit_code = 5


class DeviceAbsentError(DeviceError):
    """The port is not there, or another process holds it."""


class DeviceSilentError(DeviceError):
    """No answer within the deadline."""


class DeviceFaultError(DeviceError):
    """The device reports an alarm or an error code."""


class ProtocolError(DeviceError):
    """The device sent something that its protocol does not allow."""


class CalibrationError(EcholumeError):
    """A calibration cannot be used or made."""

    exit_code = 6


class CalibrationMissingError(CalibrationError):
    """There is no calibration for this rig."""


class CalibrationRejectedError(CalibrationError):
    """The data do not support a calibration."""


class ArchiveError(EcholumeError):
    """The raw archive cannot be written or read."""

    exit_code = 7


class ScanError(EcholumeError):
    """A scan cannot go on."""


class WrongStateError(ScanError):
    """The command does not fit the run state."""

    exit_code = 4


class LeaseHeldError(ScanError):
    """Another client holds the command lease."""

    exit_code = 4


class IncompleteScanError(ScanError):
    """The scan ended with triggers missing."""

    exit_code = 8
