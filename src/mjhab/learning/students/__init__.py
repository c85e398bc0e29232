"""Student policies (networks trained by imitation): one file per algorithm, and their common base class."""
