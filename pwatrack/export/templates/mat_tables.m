function t = @name@_tables()
% The constants of the controller: see @name@_init.
persistent known
if isempty(known)
@tables@
end
t = known;
end
