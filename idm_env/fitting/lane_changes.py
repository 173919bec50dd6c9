"""The command ``fit --lane-changes``: a file with lanes in, MOBIL's parameters and held-out likelihoods out."""

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from idm_env.data import DataError, Trajectories
from idm_env.effects import Brakes, Mobil, base_named
from idm_env.fitting import discrete_choice
from idm_env.fitting.lane_decisions import Decisions, recorded_decisions
from idm_env.fitting.options import Source, saved_model
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress, silent
from idm_env.model_file import Model, save_model
from idm_env.parameters import replaced
from idm_env.reports import page
from idm_env.roads import Lanes
from idm_env.types import Command, Record

WRITTEN = ("model.yaml", "report.json", "report.html")
"""What ``fit_lane_changes`` writes."""
FOLDS = 5
FEW = 30
"""With fewer changes than these no number of a fit is worth much, and the report says so."""


@dataclass(frozen=True)
class ChangeOptions:
    """Options of a fit of lane changes.

    ``model`` is a saved model, whose car-following law (and other effects) judge the hypothetical pairs; without it
    ``base`` does with its defaults. ``every`` (s), ``ahead`` (s) and ``first_lane`` are those of
    ``recorded_decisions``. ``free`` are the parameters that are fitted; None takes all of MOBIL's.
    """

    model: str | None = None
    base: str | None = None
    every: float = 1.0
    ahead: float = 0.0
    first_lane: str = "left"
    free: tuple[str, ...] | None = None
    seed: int = 0


class LaneChanges(NamedTuple):
    """Decisions, the models fitted to them (MOBIL first), and their likelihoods of held-out drivers."""

    decisions: Decisions
    fitted: tuple[discrete_choice.Chosen, ...]
    held_out: tuple[discrete_choice.HeldOut, ...]
    model: Model

    @property
    def mobil(self) -> discrete_choice.Chosen:
        """The fit of the effects."""
        return self.fitted[0]

    def compared(self) -> list[dict[str, Any]]:
        """Return one row per model: log-likelihoods, and by how much MOBIL's is larger on unseen drivers."""
        rows = []
        for chosen, seen in zip(self.fitted, self.held_out, strict=True):
            ahead = discrete_choice.per_vehicle(self.decisions, self.held_out[0].log_likelihood - seen.log_likelihood)
            row: dict[str, Any] = {"model": chosen.model.title, "parameters": len(chosen.theta)}
            row |= {"fitted": chosen.log_likelihood, "held_out": float(seen.log_likelihood.sum())}
            row |= {"mobil_gains": float(ahead.sum()), "standard_error": float(ahead.std() * len(ahead) ** 0.5)}
            rows.append(row | {"expected_changes": float(seen.probabilities[:, 1:].sum())})
        return rows

    def calibration(self, which: int = 0) -> list[dict[str, Any]]:
        """Return expected and observed changes of held-out drivers, in bins of about equal expected changes."""
        risk = self.held_out[which].probabilities[:, 1:].sum(-1)
        changed = (self.decisions.chosen > 0).double()
        bins = min(5, max(2, self.decisions.changes // 5))
        order = risk.argsort()
        share = risk[order].cumsum(0) / risk.sum()
        bin_of = torch.bucketize(share, torch.linspace(0, 1, bins + 1, dtype=torch.float64)[1:-1])
        rows = []
        for k in range(bins):
            mine = order[bin_of == k]
            if len(mine):
                ends = {"lowest": float(risk[mine].min()), "highest": float(risk[mine].max())}
                sums = {"expected": float(risk[mine].sum()), "observed": int(changed[mine].sum())}
                rows.append({"decisions": len(mine), **ends, **sums})
        return rows


def lane_changes(
    trajectories: Trajectories, options: ChangeOptions | None = None, on_progress: OnProgress | None = None
) -> LaneChanges:
    """Fit MOBIL's parameters to the lane changes of a file, and judge them on drivers that the fit has not seen.

    Every driver is judged by fits to the drivers of the other four of five folds; so are a constant rate and a logit of
    gap acceptance. DataError and ValueError for what cannot be fitted.
    """
    options, progress = options or ChangeOptions(), on_progress or silent
    model = _model(options)
    progress("decisions", 0, 0, trajectories.source)
    when: dict[str, Any] = {name: getattr(options, name) for name in ("every", "ahead", "first_lane")}
    decisions = recorded_decisions(trajectories, model.simulator, _params_of(model), **when)
    free = options.free or tuple(f"{Mobil.kind}.{p.name}" for p in Mobil.declared)
    mobil = discrete_choice.UtilityLogit(model.simulator(Lanes(2)), free)
    models: list[discrete_choice.Choice] = [mobil, discrete_choice.CONSTANT_RATE, discrete_choice.GAP_ACCEPTANCE]
    fitted = []
    for k, each in enumerate(models):
        progress("fitting", k, len(models), each.title)
        fitted.append(discrete_choice.fit_choice(each, decisions))
    progress("drivers held out", 0, 0, f"{FOLDS} folds")
    fold = discrete_choice.folds(decisions, FOLDS, options.seed)
    if int(torch.unique(fold[decisions.vehicle[decisions.chosen > 0]]).numel()) < 2:
        raise DataError(f"{trajectories.source}: only one driver changes lanes. Nobody could be held out; take more.")
    seen = discrete_choice.held_out(fitted, decisions, fold)
    numbers = replaced(model.parameters, dict(zip(free, fitted[0].theta.tolist(), strict=False)))
    return LaneChanges(decisions, tuple(fitted), tuple(seen), replace(model, parameters=numbers, fitted_on={}))


def _model(options: ChangeOptions) -> Model:
    """Return the model that judges, with MOBIL where it has no effect that changes lanes."""
    model = saved_model(options.model, options.base) or Model((base_named(options.base or "idm"), Brakes()))
    effects = tuple(e for e in model.effects if e.takes not in (Command, Record) and e.name != Mobil.kind)
    return replace(model, effects=(*effects, Mobil(every=options.every)))


def _params_of(model: Model) -> Any:
    """Return a function of ``"run/vehicle"``: the driver's own parameters where the model knows him."""
    params = cache(partial(model.params, dtype=torch.float64))
    return lambda vehicle: params(vehicle if model.by == "driver" and vehicle in model.drivers else None)


def fit_lane_changes(
    source: Source, options: ChangeOptions, out: Path, *, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Fit the lane changes of a file and return the report; write it, and ``model.yaml``."""
    progress = on_progress or silent
    with storage.results(out, WRITTEN, (source.path, options.model)):
        progress("reading", 0, 0, source.path.name)
        trajectories = source.trajectories()
        fit = lane_changes(trajectories, options, progress)
        progress("writing", 0, 0, "the report")
        result = _result(fit, trajectories, options)
        save_model(out / "model.yaml", fit.model)
        template, title = Path(__file__).with_suffix(".html"), f"Lane changes of {trajectories.source}"
        return page.write_report(out, title, template, result, picture=_calibration_picture(fit))


def _result(fit: LaneChanges, trajectories: Trajectories, options: ChangeOptions) -> dict[str, Any]:
    decisions, compared = fit.decisions, fit.compared()
    account = page.account(trajectories.repairs, decisions.left_out)
    left = int((decisions.chosen == 1).sum())
    counts = {"count": len(decisions), "changes": decisions.changes, "left": left, "right": decisions.changes - left}
    vehicles = int(decisions.vehicle.unique().numel())
    return {
        "data": {**trajectories.summary(), "left_out": [str(r) for r in decisions.left_out], "account": account},
        "options": vars(options),
        "decisions": {**counts, "vehicles": vehicles},
        "parameters": fit.mobil.table(),
        "models": compared,
        "calibration": fit.calibration(),
        "sentence": _sentence(fit, compared),
    }


def _sentence(fit: LaneChanges, compared: list[dict[str, Any]]) -> str:
    """Return the finding in a sentence that follows the figures."""
    decisions = fit.decisions
    verdicts = []
    for row in compared[1:]:
        gain, error = row["mobil_gains"], row["standard_error"]
        word = "better than" if gain > 1.96 * error else "worse than" if gain < -1.96 * error else "not told from"
        verdicts.append(f"{word} {row['model']} ({gain:+.1f} ± {error:.1f})")
    unknown = [row["parameter"] for row in fit.mobil.table() if not row["identified"]]
    doubt = f" Not identified by these data: {', '.join(map(str, unknown))}." if unknown else ""
    few = f" {decisions.changes} changes are few: they describe only." if decisions.changes < FEW else ""
    return (
        f"{decisions.changes} lane changes in {len(decisions)} decisions. On drivers whom the fit has not seen, by "
        f"log-likelihood, MOBIL is {' and '.join(verdicts)}.{doubt}{few}"
    )


def _calibration_picture(fit: LaneChanges) -> page.Block:
    """Draw observed over expected changes, by bins, for all models."""
    figure, axes = page.figure(1, 1, size=(5.6, 3.6))
    axis, most = axes[0, 0], 1.0
    for k, (chosen, colour) in enumerate(zip(fit.fitted, ("#1e5adc", "#999999", "#d1495b"), strict=True)):
        rows = fit.calibration(k)
        rate, seen = (np.array([row[n] / row["decisions"] * 100 for row in rows]) for n in ("expected", "observed"))
        error = np.array([np.sqrt(max(row["observed"], 1)) / row["decisions"] * 100 for row in rows])
        axis.errorbar(rate, seen, error, fmt="o-", ms=4, lw=1, color=colour, label=chosen.model.title)
        most = max(most, rate.max(), (seen + error).max())
    axis.plot([0, most], [0, most], color="#20242c", lw=0.8)
    axis.set(xlabel="changes expected (% of decisions)", ylabel="changes observed (%)", xlim=(0, None), ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)
    axis.grid(alpha=0.25)
    return page.picture(figure, "Drivers that were held out: bins of about the same expected changes; bars: √n.")


__all__ = ["WRITTEN", "ChangeOptions", "LaneChanges", "fit_lane_changes", "lane_changes"]
