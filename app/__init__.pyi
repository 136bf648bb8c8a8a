from .api.evaluate import campaign as campaign
from .api.evaluate import compare as compare
from .api.evaluate import export as export
from .api.evaluate import filter as filter  # noqa: A004  # the word that people look for
from .api.evaluate import import_run as import_run
from .api.evaluate import load as load
from .api.evaluate import model as model
from .api.evaluate import table as table
from .api.gap import diagnose as diagnose
from .api.gap import diagnose_many as diagnose_many
from .api.gap import gap_evaluate as gap_evaluate
from .api.gap import isolability as isolability
from .api.gap import next_experiment as next_experiment
from .api.measure import check as check
from .api.measure import examine as examine
from .api.measure import resume as resume
from .api.measure import run as run
from .api.measure import simulate as simulate
from .api.model_fit import IdentifiedCampaign as IdentifiedCampaign
from .api.model_fit import identify as identify
from .api.model_fit import identify_many as identify_many
from .api.reports import paper as paper
from .api.reports import report as report
from .api.settle import resume_settling as resume_settling
from .api.settle import settle as settle
from .api.stage import calibrate_encoder as calibrate_encoder
from .api.stage import calibrate_force as calibrate_force
from .api.stage import home as home
from .api.stage import jog as jog
from .api.stage import touch_off as touch_off
from .campaign_session import Made as Made
from .exam.blind_exam import gap_blind as gap_blind
from .exam.learning import gap_calibrate as gap_calibrate
from .exam.learning import gap_cross_validate as gap_cross_validate
from .rig.runfile import Campaign as Campaign
from .rig.runfile.model import Run as Run

__version__: str
