"""What all sections of a spec file have in common."""

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A mapping in the file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @classmethod
    def written_keys(cls) -> list[str]:
        """Return its keys, as they stand in a file."""
        return [field.alias or name for name, field in cls.model_fields.items()]
