// One LZB impact of three Hertz balls in Siconos 4.4: `siconos_three_balls e k2 step`.
//
// Ball 1 flies over a small gap towards balls 2 and 3, which touch. Prints the velocities after the
// impact and the seconds of the event that computes it (model and event search are not timed).

#include <SiconosKernel.hpp>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <vector>

namespace {

SP::SiconosVector scalar(double value) {
    SP::SiconosVector out(new SiconosVector(1));
    (*out)(0) = value;
    return out;
}

SP::LagrangianLinearTIDS ball(double position, double velocity) {
    SP::SiconosMatrix mass(new SimpleMatrix(1, 1));
    (*mass)(0, 0) = 1.0;
    return SP::LagrangianLinearTIDS(
        new LagrangianLinearTIDS(scalar(position), scalar(velocity), mass));
}

SP::Interaction contact(double restitution, double stiffness) {
    SP::SimpleMatrix normal(new SimpleMatrix(1, 2));
    (*normal)(0, 0) = -1.0;
    (*normal)(0, 1) = 1.0;
    SP::NonSmoothLaw law(new MultipleImpactNSL(restitution, stiffness, 1.5));
    SP::Relation gap(new LagrangianLinearTIR(normal, scalar(-1.0)));  // diameter 1
    return SP::Interaction(new Interaction(law, gap));
}

}  // namespace

int main(int count, char** given) {
    if (count != 4) return 2;
    const double e = std::atof(given[1]), k2 = std::atof(given[2]), step = std::atof(given[3]);
    constexpr double GAP = 0.125, VELOCITY_ZERO = 1e-12, ENERGY_ZERO = 1e-24;
    try {
        const std::vector<SP::LagrangianLinearTIDS> balls{ball(-GAP, 1.0), ball(1.0, 0.0),
                                                          ball(2.0, 0.0)};
        SP::NonSmoothDynamicalSystem system(new NonSmoothDynamicalSystem(0.0, 10.0));
        for (const auto& one : balls) system->insertDynamicalSystem(one);
        system->link(contact(e, 1.0), balls[0], balls[1]);
        system->link(contact(e, k2), balls[1], balls[2]);

        std::shared_ptr<MultipleImpact> impact(new MultipleImpact("BiStiffness", step));
        impact->SetSaveData(false);
        impact->SetNstepMax(2000000000);
        impact->SetTolVel(VELOCITY_ZERO);
        impact->SetTolEner(ENERGY_ZERO);
        impact->SetZeroVelEndImp(VELOCITY_ZERO);
        impact->SetZeroEnerEndImp(ENERGY_ZERO);
        impact->setTolImpact(VELOCITY_ZERO);
        SP::TimeDiscretisation times(new TimeDiscretisation(0.0, 0.5));
        SP::EventDriven simulation(new EventDriven(system, times));
        simulation->insertIntegrator(SP::OneStepIntegrator(new LsodarOSI()));
        simulation->insertNonSmoothProblem(impact, SICONOS_OSNSP_ED_IMPACT);
        simulation->insertNonSmoothProblem(SP::OneStepNSProblem(new LCP()),
                                           SICONOS_OSNSP_ED_SMOOTH_ACC);
        simulation->setPrintStat(false);
        simulation->initialize();
        for (int event = 0; event < 10 && simulation->hasNextEvent(); ++event) {
            simulation->advanceToEvent();
            const auto start = std::chrono::steady_clock::now();
            simulation->processEvents();
            const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
            if ((*balls[1]->velocity())(0) == 0.0) continue;  // not the impact yet
            std::printf("result");
            for (const auto& one : balls) std::printf(" %.17g", (*one->velocity())(0));
            std::printf(" %.9g\n", seconds.count());
            return 0;
        }
    } catch (...) {
        std::cerr << "Siconos raised an exception" << std::endl;
    }
    return 1;
}
