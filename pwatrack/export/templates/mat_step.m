function [u, state] = @name@_step(state, y@ref@)
% Run the controller once: see @name@_init.
@checks@
t = @name@_tables();
@zeros@
@body@
end
