model CoolingLine
  "Liquid-cooling line: cold plates, coolant loop with pipes, pump, heat exchanger, valve"
  // The equations of model.c for users with a Modelica tool; no library is needed.

  // Parameters; the defaults are those of model.toml, an 80 kW line
  parameter Real UA(unit="W/K") = 20e3 "Overall conductance of the heat exchanger";
  parameter Real plate_UA(unit="W/K") = 4941.326918286824 "Plates to coolant, isothermal plate";
  parameter Real coolant_flow(unit="W/K") = 8000
    "Heat capacity flow of the coolant at nominal pump speed";
  parameter Real water_flow_max(unit="kg/s") = 3.64
    "Facility water with the valve open and a nominal header";
  parameter Real water_heat(unit="J/(kg.K)") = 4180 "Specific heat of the facility water";
  parameter Real plate_capacity(unit="J/K") = 24e3 "Cold plates and silicon";
  parameter Real return_capacity(unit="J/K") = 110e3 "Coolant on the hot side of the rack";
  parameter Real return_pipe_capacity(unit="J/K") = 40e3 "Coolant in the return pipe";
  parameter Real supply_capacity(unit="J/K") = 110e3 "Coolant in the heat exchanger";
  parameter Real supply_pipe_capacity(unit="J/K") = 40e3 "Coolant in the supply pipe";
  parameter Real leakage(unit="1/K") = 0.004 "More power per kelvin of the plate";
  parameter Real leakage_from(unit="K") = 331.8514613778705
    "Plate temperature at which the heat load is what the input says";
  parameter Real rangeability = 50 "Of the equal-percentage valve";
  parameter Real authority = 0.5
    "Share of the valve in the pressure drop of the open primary circuit";
  parameter Real stroke_time(unit="s") = 120 "Valve from closed to open at its fastest";
  parameter Real positioner_time(unit="s") = 2 "Time constant of the valve near its command";
  parameter Real pump_time(unit="s") = 6 "Time constant of the coolant flow";

  input Real heat_load(unit="W", start=80e3) "IT power, without leakage";
  input Real valve(start=0.7167710493689767) "Command of the primary valve, 0 closed to 1 open";
  input Real pump(start=1) "Speed of the coolant pump, 1 nominal, 0 off";
  input Real header(start=1) "Pressure across the primary circuit, 1 nominal";
  input Real facility_temperature(unit="K", start=305.15) "Facility water supply";

  Real T_plate(unit="K", start=331.8514613778705, fixed=true) "Plates";
  Real T_return(unit="K", start=320.15, fixed=true) "Coolant leaving the rack";
  Real T_return_pipe(unit="K", start=320.15, fixed=true) "Coolant entering the heat exchanger";
  Real T_supply(unit="K", start=310.15, fixed=true) "Coolant leaving the heat exchanger";
  Real T_supply_pipe(unit="K", start=310.15, fixed=true) "Coolant entering the rack";
  Real position(start=0.7167710493689767, fixed=true) "Valve position";
  Real speed(start=1, fixed=true) "Pump speed";
  Real energy_in(unit="J", start=0, fixed=true) "Heat released since the start";
  Real energy_out(unit="J", start=0, fixed=true) "Heat to the facility water since the start";

  output Real supply_temperature(unit="K") "Coolant leaving the heat exchanger";
  output Real return_temperature(unit="K") "Coolant entering the heat exchanger";
  output Real case_temperature(unit="K") "Plates";
  output Real valve_position "Feedback of the valve";
  output Real kv "Flow coefficient of the primary circuit, 1 when the valve is open";
  output Real primary_heat_flow(unit="W") "Heat to the facility water";
  output Real primary_flow(unit="kg/s") "Facility water";
  Real heat_released(unit="W") "Heat load with leakage";
  Real stored_energy(unit="J") "Heat in plates and coolant above 273.15 K";

protected
  Real phi "Characteristic of the valve";
  Real coolant(unit="W/K") "Heat capacity flow of the coolant";
  Real water(unit="W/K") "Heat capacity flow of the facility water";
  Real kappa(unit="W/K") "Heat per kelvin between the inlets of the heat exchanger";
  Real contact(unit="W/K") "Heat per kelvin between plates and mean coolant";
  Real picked_up(unit="W") "Heat from the plates to the coolant";

  function exchange "Counterflow heat exchanger by the effectiveness-NTU method"
    input Real UA;
    input Real a "One heat capacity flow";
    input Real b "The other one";
    output Real kappa;
  protected
    Real x;
  algorithm
    if a <= 0 or b <= 0 then
      kappa := 0;
    else
      x := UA*(1/a - 1/b)/2;
      kappa := 1/((1/a + 1/b)/2 + (if abs(x) < 1e-3 then 1 + x^2/3 else x/tanh(x))/UA);
    end if;
  end exchange;

equation
  coolant = coolant_flow*max(speed, 0);
  phi = rangeability^(position - 1);
  kv = 1/sqrt(authority/phi^2 + 1 - authority);
  primary_flow = water_flow_max*kv*sqrt(max(header, 0));
  water = water_heat*primary_flow;
  kappa = exchange(UA, coolant, water);
  contact = if coolant > 0 then 2*coolant*tanh(plate_UA/(2*coolant)) else 0;

  heat_released = heat_load*(1 + leakage*(T_plate - leakage_from));
  picked_up = contact*(T_plate - (T_return + T_supply_pipe)/2);
  primary_heat_flow = kappa*(T_return_pipe - facility_temperature);

  plate_capacity*der(T_plate) = heat_released - picked_up;
  return_capacity*der(T_return) = picked_up + coolant*(T_supply_pipe - T_return);
  return_pipe_capacity*der(T_return_pipe) = coolant*(T_return - T_return_pipe);
  supply_capacity*der(T_supply) = coolant*(T_return_pipe - T_supply) - primary_heat_flow;
  supply_pipe_capacity*der(T_supply_pipe) = coolant*(T_supply - T_supply_pipe);
  der(position) = min(max((min(max(valve, 0), 1) - position)/positioner_time,
    -1/stroke_time), 1/stroke_time);
  der(speed) = (max(pump, 0) - speed)/pump_time;
  der(energy_in) = heat_released;
  der(energy_out) = primary_heat_flow;

  supply_temperature = T_supply;
  return_temperature = T_return_pipe;
  case_temperature = T_plate;
  valve_position = position;
  stored_energy = plate_capacity*(T_plate - 273.15) + return_capacity*(T_return - 273.15)
    + return_pipe_capacity*(T_return_pipe - 273.15) + supply_capacity*(T_supply - 273.15)
    + supply_pipe_capacity*(T_supply_pipe - 273.15);

  annotation (experiment(StopTime=3600, Interval=5, Tolerance=1e-8));
end CoolingLine;
