"""An exam of the gap diagnosis on campaigns whose hidden effects it cannot know.

| module | what |
|---|---|
| `mixing` | which effects are hidden in how many campaigns |
| `sealing` | the exam's folder, and its answers, whose hash is written before any campaign |
| `making` | the blind plant's side: campaigns, and how large what is hidden in them is |
| `examinee` | the diagnosis' side: given a folder, it knows nothing of the plant |
| `holding` | the exam from its seal to its score |

Nothing is loaded with this package, so that who diagnoses does not load the plant.
"""
