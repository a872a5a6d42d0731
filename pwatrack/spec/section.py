"""What all sections of a spec file have in common."""

from typing import Any

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler


class Section(BaseModel):
    """A mapping in the file: unknown keys are errors. The text below a key says in the schema what it means."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        schema = handler(core)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for name, text in cls._meanings().items():
            properties[cls.model_fields[name].alias or name]["description"] = text
        return schema

    @classmethod
    def _meanings(cls) -> dict[str, str]:
        """Return the text below each key. Pydantic would read them at each start of the program, for 0.1 s."""
        import ast
        import inspect
        from itertools import pairwise

        found = dict[str, str]()
        for section in reversed([base for base in cls.__mro__ if issubclass(base, Section)]):
            body = ast.parse(inspect.getsource(section)).body[0]
            assert isinstance(body, ast.ClassDef)
            for key, text in pairwise(body.body):
                match key, text:
                    case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(said))):
                        found[name] = inspect.cleandoc(said)
        return found

    @classmethod
    def written_keys(cls) -> list[str]:
        """Return its keys, as they stand in a file."""
        return [field.alias or name for name, field in cls.model_fields.items()]
