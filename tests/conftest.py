"""In the test run, and nowhere else, the annotations of the array functions below are checked at each call."""

from beartype import BeartypeConf
from beartype.claw import beartype_packages

# Left out: what takes structured arrays or bare protocols, which beartype cannot tell apart, and geometry, whose checks
# draw random numbers where hypothesis allows none.
CHECKED = (
    "echolume_messages.calibration",
    "echolume_messages.codec",
    "echolume_messages.header",
    "echolume_messages.plan",
    "echolume_messages.rig",
    "echolume_processing.optical.blais_rioux",
    "echolume_processing.optical.camera",
    "echolume_processing.optical.correspond",
    "echolume_processing.optical.rig_frame",
    "echolume_processing.optical.triangulate",
    "echolume_processing.ultrasonic.acoustics",
    "echolume_processing.ultrasonic.contact",
    "echolume_processing.ultrasonic.cross_talk",
    "echolume_processing.ultrasonic.envelope",
    "echolume_processing.ultrasonic.flight",
    "echolume_processing.ultrasonic.image",
    "echolume_processing.ultrasonic.lobes",
    "echolume_processing.ultrasonic.plate",
    "echolume_processing.ultrasonic.plate_energy",
    "echolume_processing.ultrasonic.table_one",
)

beartype_packages(CHECKED, conf=BeartypeConf(is_pep484_tower=True))
