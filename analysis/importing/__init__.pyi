from .importer import ImportedRun as ImportedRun
from .importer import import_file as import_file
from .mapping import ColumnMap as ColumnMap
from .mapping import ColumnSource as ColumnSource
from .mapping import ImportSettings as ImportSettings
from .mapping import parse_map as parse_map
from .readers import read_foreign as read_foreign
