"""A check of this machine, each fault with its cure: ``idm-env doctor``."""

import os
import platform
import re
import tempfile
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

EXTRAS = ("data", "kernels", "render", "sb3", "ray")


class Finding(NamedTuple):
    """One thing that was looked at: ``ok``, ``missing`` (something is slower or absent) or ``broken``, and the cure."""

    what: str
    state: str
    told: str
    cure: str = ""


def findings(folder: Path = Path()) -> list[Finding]:
    """Return all findings; ``folder`` is where results would be written."""
    caches = {"cache of printed steps": "IDM_ENV_CACHE", "compiled loops": "NUMBA_CACHE_DIR"}
    machine = [*_versions(), *(_extra(name) for name in EXTRAS), _kernels(), _threads(), _gpu()]
    results = _writable("results", folder, "Go to a folder that you may write to, or give --out one.")
    return [*machine, *(_cache(*pair) for pair in caches.items()), results]


def _versions() -> list[Finding]:
    system = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    results = [Finding("system", "ok", system)]
    for name in ("idm-env", "torch", "numpy", "gymnasium", "pettingzoo"):
        try:
            results.append(Finding(name, "ok", version(name)))
        except PackageNotFoundError:
            absent = ("broken", "not installed", f"pip install {name}")
            checkout = ("missing", "runs from a checkout that is not installed", "pip install -e .")
            results.append(Finding(name, *(checkout if name == "idm-env" else absent)))
    return results


def _extra(name: str) -> Finding:
    """Return whether all that an extra asks for is installed."""
    try:
        lines = requires("idm-env") or []
    except PackageNotFoundError:
        return Finding(f"extra {name}", "missing", "not known: the package is not installed", "pip install -e '.[all]'")
    mine = [line for line in lines if re.search(rf"extra == ['\"]{name}['\"]", line)]
    have, absent = [], []
    for line in mine:
        package = re.split(r"[^\w.-]", line, maxsplit=1)[0]
        try:
            have.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            absent.append(package)
    if absent or not mine:
        message = f"absent: {', '.join(absent)}" if absent else "not known to the installed package"
        return Finding(f"extra {name}", "missing", message, f"pip install 'idm-env[{name}]'")
    return Finding(f"extra {name}", "ok", ", ".join(have))


def _kernels() -> Finding:
    """Run a compiled lane beside the torch path."""
    if os.environ.get("IDM_ENV_KERNELS") == "0":
        return Finding("kernels", "missing", "IDM_ENV_KERNELS=0: all runs in torch, slower", "Unset the variable.")
    if find_spec("numba") is None:
        return Finding("kernels", "missing", "no numba: all runs in torch, slower", "pip install 'idm-env[kernels]'")
    try:
        return _compared()
    except Exception as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        return Finding("kernels", "broken", words, "Delete the caches below; IDM_ENV_KERNELS=0 does without kernels.")


def _compared() -> Finding:
    import torch

    from idm_env import IDM, Brakes, Lane, Simulator
    from idm_env.compiled.kernels import dispatch

    simulator = Simulator(Lane(), (IDM(), Brakes()), dt=0.1)
    params = simulator.defaults(dtype=torch.float64)
    position = torch.tensor([60.0, 30.0, 0.0], dtype=torch.float64)
    state = simulator.state(position, torch.full_like(position, 12.0), params)
    refused = dispatch.refusal(simulator, state, {}, params)
    if refused is not None:
        return Finding("kernels", "missing", refused, "")
    compiled, _ = simulator.rollout(state, {}, params, 50)
    with dispatch.off():
        plain, _ = simulator.rollout(state, {}, params, 50)
    apart = float((compiled.gap - plain.gap).abs().max())
    if not apart < 1e-9:
        return Finding("kernels", "broken", f"a compiled lane is {apart:g} m from torch's", "Delete the caches below.")
    return Finding("kernels", "ok", f"numba {version('numba')}; a compiled lane agrees with torch's")


def _threads() -> Finding:
    import torch

    have = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    used = torch.get_num_threads()
    processors = f"{used} of {have} processors"
    if used < have:
        return Finding("threads", "missing", processors, f"Set OMP_NUM_THREADS={have}, or use --executor processes.")
    if used > have:
        return Finding("threads", "missing", processors, f"Set OMP_NUM_THREADS={have}: more threads only cost time.")
    return Finding("threads", "ok", processors)


def _gpu() -> Finding:
    import torch

    if torch.cuda.is_available():
        return Finding("GPU", "ok", f"{torch.cuda.get_device_name()}; device='cuda' runs in torch, without kernels")
    built = torch.version.cuda
    if built is None:
        return Finding("GPU", "missing", "this torch is built without CUDA; nothing here needs one", "")
    return Finding("GPU", "missing", f"torch is built for CUDA {built}, and no device answers", "Look at nvidia-smi.")


def _cache(what: str, variable: str) -> Finding:
    from idm_env.compiled.scalar import library

    wished, used = os.environ.get(variable), library.folder(variable)
    cure = f"Set {variable} to a folder to which you may write, and nobody else."
    if used is None:
        return Finding(what, "missing", "no folder serves: all is compiled at every start", cure)
    if wished and Path(os.path.realpath(wished)) != used:
        why = library.exposed(Path(os.path.realpath(wished))) if Path(wished).is_dir() else None
        return Finding(what, "broken", f"{variable}={wished} {why or 'cannot be written'}; {used} is used", cure)
    return Finding(what, "ok", str(used))


def _writable(what: str, folder: Path, cure: str) -> Finding:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".idm-env-doctor"):
            pass
    except OSError as error:
        return Finding(what, "broken", f"{folder}: {error.strerror or error}", cure)
    return Finding(what, "ok", os.path.realpath(folder))
