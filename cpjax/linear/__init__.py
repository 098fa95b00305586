"""From a linear model to a gain, differentiably; and what there is to know about that gain."""
