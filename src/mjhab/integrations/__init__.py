"""mjhab inside of other evaluation tools. Each module needs the library it is named after, or none at all."""
