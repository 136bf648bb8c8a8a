"""What runs can tell apart as JSON, for programs."""

from collections.abc import Mapping

from dragrig.analysis.gap.isolability.results import CLOSE, Isolability
from dragrig.analysis.gap.isolability.sentences import isolability_sentences
from dragrig.analysis.gap.seen import SEEN
from dragrig.identification_json import finite

FORMAT, VERSION = "dragrig-isolability", 1


def isolability_document(found: Isolability) -> Mapping[str, object]:
    """Return it as JSON without any NaN or infinity."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "source": found.source,
        "planned": found.planned,
        "runs": dict(found.runs),
        "duration_s": finite(found.duration_s),
        "in_words": list(isolability_sentences(found)),
        "seen_from_d_prime": SEEN,
        "close_below_sin2": CLOSE,
        "summary": {name: finite(value) for name, value in found.summary().items()},
        "effects": [
            {
                "id": one.effect,
                "channel": one.channel,
                "usual": one.usual,
                "unit": one.unit,
                "d_prime": finite(one.d_prime),
                "least_seen": finite(one.least),
                "least_seen_mN": finite(one.least_mN),
            }
            for one in found.effects
        ],
        "pairs": [
            {
                "effects": list(one.effects),
                "channel": one.channel,
                "sin2": finite(one.sin2),
                "typical_sin2": [finite(each) for each in one.typical_sin2],
                "d_prime": [finite(each) for each in one.d_prime],
                "confused": one.confused,
            }
            for one in found.pairs
        ],
        "remarks": list(found.remarks),
    }
