model FacilityHeader
  "Shared facility water: header pressure, supply temperature, cooler and chiller"
  // The equations of model.c for users with a Modelica tool; no library is needed.

  parameter Integer lines(min=1) = 64 "Length of the input kv";
  parameter Real resistance = 1
    "Shared part of the primary circuit's resistance over that of the lines; 0: ample";
  parameter Real kv_nominal = 3.5475861083014246
    "Sum of the lines' flow coefficients at which the header pressure is 1";
  parameter Real header_time(unit="s") = 2 "Time constant of the header pressure";
  parameter Real capacity(unit="J/K") = 16.7e6 "Heat capacity of the facility water";
  parameter Real set_point(unit="K") = 304.65
    "Supply temperature at which the control asks for no cooling";
  parameter Real control(unit="W/K") = 1280e3
    "Heat that the control rejects per kelvin above the set-point";
  parameter Real cooler(unit="W/K") = 106.7e3
    "Most heat that the cooler rejects per kelvin above the wet bulb";
  parameter Real chiller(unit="W") = 0 "Heat that the chiller can reject on top of the cooler";

  input Real kv[lines] "Flow coefficient of each line; 0 where there is none";
  input Real kv_others(start=0) "Sum of the flow coefficients of further lines";
  input Real heat(unit="W", start=640e3) "Heat from all lines";
  input Real wet_bulb(unit="K", start=293.15) "Outdoor wet-bulb temperature";

  Real pressure(start=1, fixed=true) "Header pressure, 1 nominal";
  Real T_supply(unit="K", start=305.15, fixed=true) "Facility water";
  Real energy_in(unit="J", start=0, fixed=true) "Heat from the lines since the start";
  Real energy_out(unit="J", start=0, fixed=true) "Heat rejected since the start";

  output Real header "Header pressure, 1 nominal: the lines' input of that name";
  output Real facility_temperature(unit="K") "Facility water supply";
  output Real rejected_heat_flow(unit="W") "Heat to the outside";
  Real stored_energy(unit="J") "Heat in the facility water above 273.15 K";

protected
  Real share "Flow coefficients over their nominal sum";

equation
  share = (sum(kv) + kv_others)/kv_nominal;
  header_time*der(pressure) = (1 + resistance)/(1 + resistance*share^2) - pressure;
  rejected_heat_flow = min(max(control*(T_supply - set_point), 0),
    cooler*max(T_supply - wet_bulb, 0) + chiller);
  capacity*der(T_supply) = heat - rejected_heat_flow;
  der(energy_in) = heat;
  der(energy_out) = rejected_heat_flow;
  header = pressure;
  facility_temperature = T_supply;
  stored_energy = capacity*(T_supply - 273.15);

  annotation (experiment(StopTime=3600, Interval=5, Tolerance=1e-8));
end FacilityHeader;
