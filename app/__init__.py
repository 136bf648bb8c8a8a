"""dragrig: runs a linear-motor drag tester, real or simulated, and evaluates its records.

`__init__.pyi` lists the public names and their modules, which are loaded on first use: the command line must start
without any of them.

Examples
--------
>>> import dragrig
>>> dragrig.check("drag").findings
()
"""

import lazy_loader

__version__ = "0.1.0"

_load, _dir, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *_names]  # noqa: PLE0604  # the names of the stub

_FORMER_NAMES = {
    "diagnose": "gap_diagnose", "diagnose_many": "gap_diagnose_many", "diagnose_together": "gap_diagnose_together",
    "isolability": "gap_isolability", "next_experiment": "gap_next", "settle": "gap_settle",
    "resume_settling": "gap_settle_resume",
}  # fmt: skip


def __getattr__(name: str) -> object:
    if (now := _FORMER_NAMES.get(name)) is not None:
        from warnings import warn

        warn(f"dragrig.{name} is called dragrig.{now} now", DeprecationWarning, stacklevel=2)
    return _load(now or name)


def __dir__() -> list[str]:
    return sorted(__all__)
