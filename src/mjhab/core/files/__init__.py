"""Files of ours on disk: where they live, who may write them, which code made them."""
