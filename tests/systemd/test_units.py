"""The units as systemd's own tools judge them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest

from echolume_messages.topics import SERVICES

ROOM = Path(__file__).parents[2] / "systemd"
SAFE = Path(__file__).parents[2] / "daemon/echolume_daemon/safe.py"
UNITS = sorted(ROOM.glob("*.service"))
OWN_A_WIRE = {"guide", "cameras", "robot", "array"}
EXPOSURE_LIMIT = 2.0

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed (Debian package systemd)"
)


def lines(unit: Path, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE)


def test_there_is_a_unit_for_each_service_and_no_other() -> None:
    assert {unit.stem.removeprefix("echolume-") for unit in UNITS} == set(SERVICES)


def test_the_target_wants_them_all() -> None:
    wanted = " ".join(lines(ROOM / "echolume.target", "Wants")).split()
    assert set(wanted) == {unit.name for unit in UNITS}


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_starts_its_service_as_its_own_user_under_a_watchdog(unit: Path) -> None:
    name = unit.stem.removeprefix("echolume-")
    assert lines(unit, "ExecStart") == [f"/opt/echolume/bin/echolume serve {name} --rig /etc/echolume/rig.toml"]
    assert lines(unit, "Type") == ["notify"]
    assert lines(unit, "WatchdogSignal") == ["SIGKILL"]
    assert float(lines(unit, "WatchdogSec")[0]) <= 5
    assert lines(unit, "User") == ["echolume"]
    assert lines(unit, "Restart") == ["always"]


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_units_that_own_a_wire_are_made_safe_before_and_after_and_no_others(unit: Path) -> None:
    name = unit.stem.removeprefix("echolume-")
    safe = f"/opt/echolume/bin/python3 -I -S /opt/echolume/share/echolume/safe.py {name} --rig /etc/echolume/rig.toml"
    expected = [safe] if name in OWN_A_WIRE else []
    assert lines(unit, "ExecStartPre") == expected
    assert lines(unit, "ExecStopPost") == expected


@pytest.mark.parametrize("name", sorted(OWN_A_WIRE))
def test_the_safe_command_of_the_units_is_understood(name: str, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(
        '[guide]\nport = "/dev/echolume-none"\n[trigger]\nport = "/dev/echolume-none"\n'
        '[array]\nport = "/dev/echolume-none"\n[robot]\ninterface = "socketcan"\nchannel = "nocan9"\n',
        encoding="utf-8",
    )
    (command,) = lines(ROOM / f"echolume-{name}.service", "ExecStopPost")
    arguments = command.split()
    assert arguments[3:4] == ["/opt/echolume/share/echolume/safe.py"]
    run = subprocess.run(
        [sys.executable, *arguments[1:3], str(SAFE), *arguments[4:-1], str(rig)],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert (run.returncode, "absent" in run.stdout) == (0, True), run.stderr


@needs_systemd
def test_systemd_finds_nothing_wrong_with_the_units(tmp_path: Path) -> None:
    for path in (*UNITS, ROOM / "echolume.target"):
        # `verify` wants the programs to exist; the rig's live in /opt/echolume
        text = path.read_text(encoding="utf-8")
        text = text.replace("/opt/echolume/bin/python3", sys.executable).replace(
            "/opt/echolume/bin/echolume", sys.executable
        )
        (tmp_path / path.name).write_text(text, encoding="utf-8")
    run = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *map(str, sorted(tmp_path.iterdir()))],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_exposes_little(unit: Path) -> None:
    run = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", run.stdout)
    assert found is not None, run.stdout
    assert float(found[1]) <= EXPOSURE_LIMIT


def test_udev_gives_the_names_that_the_guide_to_installing_uses() -> None:
    rules = (ROOM / "60-echolume.rules").read_text(encoding="utf-8")
    assert set(re.findall(r'SYMLINK\+="echolume/(\w+)"', rules)) == {"guide", "trigger", "array"}
    assert rules.count("GOTO=") == 2
    assert 'LABEL="echolume_end"' in rules


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd-sysusers is not installed")
def test_sysusers_understands_the_user(tmp_path: Path) -> None:
    config = str(ROOM / "echolume.sysusers.conf")
    run = subprocess.run(
        ["systemd-sysusers", "--root", str(tmp_path), "--dry-run", "--inline", *_settings(config)],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert run.returncode == 0, run.stderr


def _settings(path: str) -> list[str]:
    text = Path(path).read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_no_setting_stands_outside_its_section(unit: Path) -> None:
    parser = ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment]
    parser.read(unit, encoding="utf-8")
    assert parser.sections() == ["Unit", "Service", "Install"]
