"""An environment that a person drives: what keys mean, the session, and what is shown of it."""
