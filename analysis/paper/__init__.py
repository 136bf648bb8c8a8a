"""The paper checked against its own model: its printed numbers, their implications, and where the two disagree.

| module | content |
|---|---|
| `published` | the numbers that the paper prints, and the form of a finding |
| `findings.toml` | the findings in words: the paper's statement, the evidence of its numbers, dragrig's choice |
| `findings` | the values in them; Table 1 beside identified elements |

Everything is computed from the model's equations on demand; no result is typed in.

`__init__.pyi` lists the public names and their modules, which are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
