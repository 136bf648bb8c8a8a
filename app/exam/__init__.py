"""An exam of the gap diagnosis on simulated campaigns whose hidden effects it cannot know.

| module | what |
|---|---|
| `blind_campaigns` | hidden effects, simulated campaigns, and the answers, whose hash is written before any campaign |
| `examinee` | diagnoses a folder of runs without any knowledge of the plant |
| `blind_exam` | the exam from sealing the answers to its score |
| `learning` | thresholds and weights of the verdict learnt from exams, cross-validated |

Nothing is loaded with this package, so that the examinee does not load the plant.
"""
