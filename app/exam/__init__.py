"""An exam of the gap diagnosis on simulated campaigns whose hidden effects it cannot know.

| module | content |
|---|---|
| `examinee` | diagnoses a folder of runs without any knowledge of the plant |
| `blind_exam` | the exam from sealing the answers, whose hash is written before any campaign, to its score |
| `learning` | thresholds and weights of the verdict learnt from exams, cross-validated |

Nothing is loaded with this package, so that the examinee does not load the plant.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
