"""How results are written down, and read back as data."""

from lagjax.files import npz
from lagjax.files.npz import KINDS_OF_ARRAY, MALFORMED, Explained, NotGiven, NotWritable, Reader, Writer, parsed
from lagjax.files.programs import cache
from lagjax.files.table import Table, check_field, fields_of
