"""Methods and linear algebra that know no mechanics."""
