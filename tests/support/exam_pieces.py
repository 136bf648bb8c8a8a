"""Who is examined at no cost: answers that follow from the runs alone, given by other processes."""

import os
from hashlib import sha256

from dragrig.exam.examinee import BlindDiagnosis, BlindTask
from ending import kill


def quick_diagnosis(task: BlindTask) -> BlindDiagnosis:
    """Name what the bits of the runs say."""
    runs = sorted(task.campaign.glob("*.h5"))
    digest = sha256(b"".join(run.read_bytes() for run in runs)).digest()
    ranking = [{"hypothesis": "no_gap", "probability": 0.5 + digest[0] / 512}]
    return BlindDiagnosis({"verdict": "no_gap", "effects": [], "ranking": ranking, "runs": digest.hex()})


def diagnosis_killed_once(task: BlindTask) -> BlindDiagnosis:
    """Do the same; the first attempt at campaign 0002 takes its process along and leaves a trace beside the exam."""
    trace = task.campaign.parents[1].with_suffix(".killed")
    if task.campaign.name == "0002" and not trace.exists():
        trace.write_text(str(os.getpid()), "utf-8")
        kill()
    return quick_diagnosis(task)
