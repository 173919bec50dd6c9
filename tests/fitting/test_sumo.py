"""Drivers written for SUMO are those drivers in SUMO: read, and in equilibrium behind a leader."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import torch

from benchmarks.bench.peers import straight
from idm_env.effects import IDM, Brakes, Gipps
from idm_env.effects.idm import equilibrium_gap
from idm_env.fitting import sumo
from idm_env.model_file import Model, save_model

NUMBERS = {"max_accel": 1.1, "comfort_decel": 1.7, "time_gap": 1.3, "min_gap": 2.5, "desired_speed": 30.0}
OTHER = {"max_accel": 2.0, "time_gap": 0.9}
MODEL = Model((IDM(), Brakes()), {"idm": NUMBERS}, drivers={"run 1/7": {"idm": OTHER}, "run:1/7": {"idm": OTHER}})


def test_sumo_drives_as_the_fitted_drivers(tmp_path: Path) -> None:
    """Its own readers take the file; behind a leader at 15 m/s the gap is that of IDM's equilibrium."""
    libsumo = pytest.importorskip("libsumo", reason="libsumo is not installed")
    sumo.write(tmp_path / "vtypes.add.xml", MODEL)
    (tmp_path / "net.xml").write_text(straight(9000.0, 50.0))
    (tmp_path / "r.rou.xml").write_text(
        '<routes><vType id="slow" maxSpeed="15" sigma="0" speedDev="0"/><route id="r" edges="ab"/>'
        '<vehicle id="leader" type="slow" route="r" depart="0" departPos="200" departSpeed="15"/>'
        '<vehicle id="first" type="median" route="r" depart="0" departPos="150" departSpeed="15"/>'
        '<vehicle id="second" type="run_1/7" route="r" depart="0" departPos="100" departSpeed="15"/></routes>'
    )
    files = {"-n": "net.xml", "-a": "vtypes.add.xml", "-r": "r.rou.xml"}
    words = [x for option, name in files.items() for x in (option, str(tmp_path / name))]
    libsumo.start(["sumo", *words, "--step-length", "0.1", "--no-step-log", "--time-to-teleport", "-1"])
    try:
        types = libsumo.vehicletype
        assert {"median", "run_1/7", "run_1/7_2"} <= set(types.getIDList())
        assert (types.getAccel("run_1/7"), types.getTau("run_1/7")) == (2.0, 0.9)
        told = (types.getAccel, types.getDecel, types.getTau, types.getMinGap, types.getMaxSpeed)
        assert [read("median") for read in told] == list(NUMBERS.values())
        for _ in range(3000):
            libsumo.simulationStep()
        for vehicle, driver in (("first", None), ("second", "run 1/7")):
            _, gap = libsumo.vehicle.getLeader(vehicle)
            law = IDM().driver(MODEL.params(driver, dtype=torch.float64)["idm"])
            wanted = float(equilibrium_gap(law, torch.tensor(15.0, dtype=torch.float64)))
            assert libsumo.vehicle.getSpeed(vehicle) == pytest.approx(15.0, abs=0.05)
            # SUMO's gap begins behind the standstill gap.
            assert gap + types.getMinGap(libsumo.vehicle.getTypeID(vehicle)) == pytest.approx(wanted, rel=0.03)
    finally:
        libsumo.close()


def test_what_sumo_has_not_and_files_of_others_are_refused(tmp_path: Path) -> None:
    """One line each; what was written before is written anew."""
    path = tmp_path / "vtypes.add.xml"
    sumo.write(path, MODEL)
    sumo.write(path, MODEL)
    assert len(ElementTree.parse(path).getroot()) == 3
    with pytest.raises(ValueError, match="the law is gipps"):
        sumo.refuse(path, Gipps().kind)
    save_model(tmp_path / "mine.xml", MODEL)
    with pytest.raises(ValueError, match="was not written by idm-env fit"):
        sumo.write(tmp_path / "mine.xml", MODEL)
