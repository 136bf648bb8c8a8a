from .blind_exam import gap_blind as gap_blind
from .learning import gap_calibrate as gap_calibrate
from .learning import gap_cross_validate as gap_cross_validate
