"""Optuna's searches for comparison with cli/search: search_optuna.py; needs optuna.

Prints what TPESampler(multivariate) and RandomSampler find of the functions of cli/search/tests/it/objectives.rs, with 60
trials in rounds of 6 and 24 seeds: medians of the least values."""

import math
import statistics
import warnings

import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

optuna.logging.set_verbosity(optuna.logging.ERROR)
warnings.simplefilter("ignore")


def decades(x, by):
    return math.log10(x / by)


def lists(v):
    rate, worse = {"a": (1e-4, 0.8), "b": (1e-2, 0.0), "c": (1e-3, 0.4), "d": (3e-5, 1.5)}[v["kind"]]
    return decades(v["lr"], rate) ** 2 + worse + (0 if v["schedule"] == "cosine" else 0.3)


def valley(v):
    a, b = v["a"], v["b"]
    least = (1 - a) ** 2 + 10 * (b - a * a) ** 2 + decades(v["c"], 0.1) ** 2 + (v["d"] - 13) ** 2 / 40
    return least + (0 if v["e"] == "y" else 1) + v["f"]


def log(low, high):
    return FloatDistribution(low, high, log=True)


OBJECTIVES = {
    "sphere, 2 numbers": (
        {"x": FloatDistribution(-5, 5), "y": FloatDistribution(-5, 5)},
        lambda v: (v["x"] - 1.3) ** 2 + (v["y"] + 2.1) ** 2,
    ),
    "rate, decay and width": (
        {"lr": log(1e-5, 1e-1), "decay": log(1e-6, 1e-1), "width": IntDistribution(2, 64)},
        lambda v: decades(v["lr"], 2e-3) ** 2
        + 0.2 * decades(v["decay"], 1e-4) ** 2
        + 0.1 * math.log2(v["width"] / 48) ** 2,
    ),
    "of lists, and a rate that goes with one": (
        {
            "lr": log(1e-5, 1e-1),
            "kind": CategoricalDistribution(["a", "b", "c", "d"]),
            "schedule": CategoricalDistribution(["flat", "cosine", "step"]),
        },
        lists,
    ),
    "a valley over 6": (
        {
            "a": FloatDistribution(-2, 2),
            "b": FloatDistribution(-2, 2),
            "c": log(1e-3, 1e1),
            "d": IntDistribution(0, 20),
            "e": CategoricalDistribution(["x", "y", "z"]),
            "f": FloatDistribution(0, 1),
        },
        valley,
    ),
}


print(f"optuna {optuna.__version__}")
samplers = {
    "tpe": lambda seed: optuna.samplers.TPESampler(multivariate=True, constant_liar=True, seed=seed),
    "random": lambda seed: optuna.samplers.RandomSampler(seed=seed),
}
for name, (space, objective) in OBJECTIVES.items():
    medians = {}
    for sampler, make in samplers.items():
        least = []
        for seed in range(24):
            study = optuna.create_study(sampler=make(seed))
            for _ in range(10):
                for trial in [study.ask(space) for _ in range(6)]:
                    study.tell(trial, objective(trial.params))
            least.append(study.best_value)
        medians[sampler] = round(statistics.median(least), 4)
    print(f"{name}: {medians}", flush=True)
