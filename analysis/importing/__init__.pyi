from .foreign import ColumnMap as ColumnMap
from .foreign import ColumnSource as ColumnSource
from .foreign import ImportSettings as ImportSettings
from .foreign import parse_map as parse_map
from .importer import ImportedRun as ImportedRun
from .importer import import_file as import_file
from .readers import read_foreign as read_foreign
