from .importer import ImportedRun as ImportedRun
from .importer import import_file as import_file
from .importer import import_runs as import_runs
from .readers import read_foreign as read_foreign
from .settings import ColumnMap as ColumnMap
from .settings import ColumnSource as ColumnSource
from .settings import ImportSettings as ImportSettings
from .settings import parse_map as parse_map
