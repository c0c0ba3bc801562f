"""How results are written down, and read back as data."""

from lagjax.files import npz
from lagjax.files.npz import MALFORMED, Explained, parsed
from lagjax.files.table import Table, check_field, fields_of
from lagjax.files.tree_json import KINDS_OF_ARRAY, NotGiven, NotWritable, Reader, Writer
