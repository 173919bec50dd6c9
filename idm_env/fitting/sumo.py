"""Fitted drivers as SUMO's vehicle types: an additional file with one ``vType`` per driver."""

import re
from pathlib import Path
from xml.sax.saxutils import quoteattr

import torch

from idm_env.effects import IDM
from idm_env.jobs.storage import refuse_unwritable, write_text
from idm_env.model_file import Model
from idm_env.roads.sumo_demand import PARAMETERS

_MARK = "<!-- Written by idm-env fit. -->"
ATTRIBUTES = {**PARAMETERS, "delta": "exponent"}
"""SUMO's attribute → IDM's parameter: m/s², m/s², s, m, m/s, none."""


def refuse(path: Path, base: str) -> None:
    """Raise ValueError, in one line, for a law that SUMO has not, and for a file that ``write`` has not written."""
    if base != "idm":
        raise ValueError(f"--sumo writes the types of IDM, and the law is {base}. Leave --sumo out, or use --base idm.")
    if path.exists() and not (path.is_file() and _MARK in path.read_text(errors="replace")):
        raise ValueError(f"{path} was not written by idm-env fit. Move it, or give --sumo another name.")
    refuse_unwritable(path, "--sumo")


def write(path: Path, model: Model) -> None:
    """Write ``median``, the model's own parameters, and every driver of his own, under ``run/vehicle``.

    The desired speed is the type's ``maxSpeed``, reached where a lane's limit allows it: ``speedFactor`` is 1 and
    vehicles of a type are alike. What SUMO takes for no name becomes ``_``; a driver whose name is taken gets ``_2``.
    """
    law = next(effect for effect in model.effects if isinstance(effect, IDM))
    refuse(path, law.kind)
    lines, taken = [], set()
    for driver in (None, *model.drivers):
        values = model.params(driver, dtype=torch.float64)[law.name]
        parameters = {"exponent": law.exponent, **{name: float(x) for name, x in values.items()}}
        printable = "".join(sign if sign.isprintable() else "_" for sign in driver or "median")
        name = stem = re.sub(r"[\s|\\'\";,:<>&]", "_", printable)
        number = 1
        while name in taken:
            number += 1
            name = f"{stem}_{number}"
        taken.add(name)
        numbers = " ".join(f'{attribute}="{parameters[parameter]:.6g}"' for attribute, parameter in ATTRIBUTES.items())
        lines.append(f'    <vType id={quoteattr(name)} carFollowModel="IDM" {numbers} speedFactor="1" speedDev="0"/>')
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "\n".join((_MARK, "<additional>", *lines, "</additional>", "")))
