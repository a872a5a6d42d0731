"""FMUs of both versions, run by FMPy, with one face."""

import ctypes
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack.arrays import Array

FMI2 = """
    GetTypesPlatform GetVersion SetDebugLogging Instantiate FreeInstance SetupExperiment EnterInitializationMode
    ExitInitializationMode Terminate Reset GetReal GetInteger GetBoolean GetString SetReal SetInteger SetBoolean
    SetString GetFMUstate SetFMUstate FreeFMUstate SerializedFMUstateSize SerializeFMUstate DeSerializeFMUstate
    GetDirectionalDerivative SetRealInputDerivatives GetRealOutputDerivatives DoStep CancelStep GetStatus GetRealStatus
    GetIntegerStatus GetBooleanStatus GetStringStatus
"""
KINDS = "Float32 Float64 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean String Binary Clock"
FMI3 = """
    GetVersion SetDebugLogging InstantiateModelExchange InstantiateCoSimulation InstantiateScheduledExecution
    FreeInstance EnterInitializationMode ExitInitializationMode EnterEventMode Terminate Reset
    GetNumberOfVariableDependencies GetVariableDependencies GetFMUState SetFMUState FreeFMUState SerializedFMUStateSize
    SerializeFMUState DeserializeFMUState GetDirectionalDerivative GetAdjointDerivative EnterConfigurationMode
    ExitConfigurationMode GetIntervalDecimal GetIntervalFraction GetShiftDecimal GetShiftFraction SetIntervalDecimal
    SetIntervalFraction SetShiftDecimal SetShiftFraction EvaluateDiscreteStates UpdateDiscreteStates EnterStepMode
    GetOutputDerivatives DoStep EnterContinuousTimeMode CompletedIntegratorStep SetTime SetContinuousStates
    GetContinuousStates GetContinuousStateDerivatives GetEventIndicators GetNominalsOfContinuousStates
    GetNumberOfEventIndicators GetNumberOfContinuousStates ActivateModelPartition
"""
NEEDED = {
    2: [f"fmi2{name}" for name in FMI2.split()],
    3: [
        f"fmi3{name}"
        for name in [*FMI3.split(), *(f"{verb}{kind}" for verb in ("Get", "Set") for kind in KINDS.split())]
    ],
}
BINARIES = {2: "linux64", 3: "x86_64-linux"}


def missing(library: Path, version: int) -> list[str]:
    """Return the functions of the standard that a shared library does not export."""
    found = ctypes.CDLL(str(library))
    return [name for name in NEEDED[version] if not hasattr(found, name)]


class Block:
    """An FMU that runs.

    Attributes:
        said: What it said, line by line.
    """

    def __init__(self, path: Path, folder: Path, start: Mapping[str, float] = {}, time: float = 0.0) -> None:
        import fmpy
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self.folder, self.said = Path(folder) / path.stem, list[str]()
        if not self.folder.exists():
            fmpy.extract(str(path), str(self.folder))
        self.description = fmpy.read_model_description(self.folder)
        self.version = int(self.description.fmiVersion[0])
        names = {"guid": self.description.guid, "modelIdentifier": self.description.coSimulation.modelIdentifier}
        made: Any = {2: FMU2Slave, 3: FMU3Slave}[self.version]
        self.fmu: Any = made(unzipDirectory=str(self.folder), instanceName="block", **names)
        self.number = {v.name: v.valueReference for v in self.description.modelVariables}
        self.whole = {v.name for v in self.description.modelVariables if v.type in ("Integer", "Int32")}
        self._instantiate()
        self.begin(start, time)

    def _instantiate(self) -> None:
        import fmpy.fmi2
        import fmpy.fmi3

        if self.version == 2:
            self._callbacks = fmpy.fmi2.fmi2CallbackFunctions()
            self._callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(self._heard)
            fmpy.fmi2.addLoggerProxy(ctypes.byref(self._callbacks))
            self.fmu.instantiate(callbacks=self._callbacks)
        else:
            self.fmu.instantiate(logMessage=fmpy.fmi3.fmi3LogMessageCallback(self._heard3))

    def _heard(self, _environment: Any, _instance: bytes, _status: int, _category: bytes, message: bytes) -> None:
        self.said.append(message.decode())

    def _heard3(self, _environment: Any, _status: int, _category: bytes, message: bytes) -> None:
        self.said.append(message.decode())

    def begin(self, start: Mapping[str, float], time: float = 0.0) -> None:
        """Initialize it with some parameters."""
        if self.version == 2:
            self.fmu.setupExperiment(startTime=time)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=time)
        self.set(list(start), list(start.values()))
        self.fmu.exitInitializationMode()

    def set(self, names: Sequence[str], values: Any) -> None:
        put = self.fmu.setReal if self.version == 2 else self.fmu.setFloat64
        if names:
            put([self.number[name] for name in names], [float(v) for v in values])

    def get(self, names: Sequence[str]) -> Array:
        if not names:
            return np.zeros(0)
        references = [self.number[name] for name in names]
        if names[0] in self.whole:
            return np.array(self.fmu.getInteger(references) if self.version == 2 else self.fmu.getInt32(references))
        return np.array(self.fmu.getReal(references) if self.version == 2 else self.fmu.getFloat64(references))

    def step(self, time: float, length: float) -> None:
        self.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=length)

    def named(self, begin: str, causality: str = "") -> list[str]:
        """Return the names of variables that begin so."""
        every = self.description.modelVariables
        return [v.name for v in every if v.name.startswith(begin) and causality in ("", v.causality)]

    def close(self) -> None:
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self.folder)
