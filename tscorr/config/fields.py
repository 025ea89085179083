"""What the tables of a configuration are made of: numbers that are numbers, and no keys that nobody knows."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, ValidatorFunctionWrapHandler, WrapValidator


class Section(BaseModel):
    """A table of the file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _or_say(allowed: str) -> WrapValidator:
    """One message instead of one for each half of a union."""

    def validated(value: Any, validate: ValidatorFunctionWrapHandler) -> Any:
        try:
            return validate(value)
        except ValidationError:
            raise ValueError(f"allowed is {allowed}") from None

    return WrapValidator(validated)


Number = Annotated[float, Strict()]
"""neither true nor a text, and so are the next two"""
Whole = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]

PerBand = Annotated[Number | list[Number], _or_say("a number, or a list of numbers, one a band")]

Share = Annotated[Number, Field(ge=0, le=1)]
SharePerBand = Annotated[Share | list[Share], _or_say("a share from 0 to 1, or a list of shares, one a band")]

NotNegative = Annotated[Number, Field(ge=0)]
Noise = tuple[NotNegative, NotNegative]
NoisePerBand = Annotated[Noise | list[Noise], _or_say("[a, b], or a list of such pairs, one a band, none below 0")]
