from .card import Card as Card
from .pci6229 import WIDE_ATTRIBUTES as WIDE_ATTRIBUTES
from .pci6229 import Attribute as Attribute
from .pci6229 import AttributeValue as AttributeValue
from .pci6229 import CardError as CardError
